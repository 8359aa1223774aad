"""What an experiment must keep within: its inputs, what is watched of its outputs, and its length."""

from collections.abc import Mapping
from typing import Any

from ehsvjax.checks import by_name, instance, number, positive
from ehsvjax.models.model import Model


class Limits:
    """Limits of an experiment, SI: `Limits(command=(-5e-3, 5e-3), position=(-0.08, 0.08), duration=10.0)`.

    `rates={"command": 0.1}` limits how fast an input runs as well.

    Attributes:
        between: name of an input or an output of the model -> (least, most). Every input must have them; outputs keep
            within theirs in the simulation of every explanation, measured or not.
        rates: name of an input -> the most that it changes by in a second; such an input starts from zero, or from
            what is nearest to it within its limits.
        duration: s, of the experiment; None: as long as the first record so far.

    """

    def __init__(
        self,
        *,
        duration: float | None = None,
        rates: Mapping[str, float] | None = None,
        **between: tuple[float, float],
    ) -> None:
        """Check the limits.

        Raises:
            ValueError: for what is no pair of numbers in order, no rate, or no time.

        """
        self.duration = None if duration is None else positive("duration", duration, "give seconds above 0")
        given = by_name("rates", rates, '{"command": 0.1}')
        remedy = "give the most that it changes by in a second"
        self.rates: Mapping[str, float] = {n: positive(f"rate of {n}", rate, remedy) for n, rate in given.items()}
        self.between: Mapping[str, tuple[float, float]] = {n: as_pair(n, pair) for n, pair in between.items()}

    def __repr__(self) -> str:
        """Return the call that makes them."""
        given: dict[str, Any] = {**self.between}
        given |= {"rates": self.rates} if self.rates else {}
        given |= {} if self.duration is None else {"duration": self.duration}
        return f"Limits({', '.join(f'{name}={value!r}' for name, value in given.items())})"


def check_limits(limits: Limits, model: Model) -> None:
    """Check that limits are those of a model.

    Raises:
        ValueError: for what is no limits, an input without them, or a name that the model does not have.

    """
    instance("limits", limits, Limits, "make them by ehsvjax.Limits(command=(-5e-3, 5e-3))")
    for name in limits.between:
        if name not in (*model.inputs, *model.outputs):
            raise ValueError(
                f"expected limits of inputs and outputs of {model.name}, {', '.join((*model.inputs, *model.outputs))}; "
                f"got {name!r}"
            )
    for name in limits.rates:
        if name not in model.inputs:
            raise ValueError(f"expected rates of inputs of {model.name}, {', '.join(model.inputs)}; got {name!r}")
    missing = [name for name in model.inputs if name not in limits.between]
    if missing:
        raise ValueError(
            f"expected limits of every input, got none of {', '.join(missing)}: Limits({missing[0]}=(...))"
        )


def as_pair(name: str, pair: Any) -> tuple[float, float]:
    """Return what lies between two numbers.

    Raises:
        ValueError: for what is no pair of finite numbers, the lower one first.

    """
    try:
        lower, upper = pair
    except (TypeError, ValueError):
        raise ValueError(f"expected {name} between (least, most), got {pair!r}: give two numbers, SI") from None
    lower, upper = (number(f"{what} of {name}", value) for what, value in (("least", lower), ("most", upper)))
    if not lower < upper:
        raise ValueError(f"expected {name} between (least, most), the lower one first; got ({lower:g}, {upper:g})")
    return lower, upper
