"""The experiments there are: commands within their limits, and constants that the rig can change."""

import functools
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ehsvjax.experiment import commands
from ehsvjax.models.model import Model
from ehsvjax.plots import quantity
from ehsvjax.record import Record

# Genes of plain commands: every kind at these amplitudes and time scales, in the middle of its limits, of fixed levels.
_AMPLITUDES, _HOLDS = (1.0, 0.5), (0.45, 0.8)
_LEVELS = (0.03, 0.91, 0.37, 0.66, 0.15, 0.82, 0.47, 0.99, 0.28, 0.72, 0.09, 0.58)


class Space(NamedTuple):
    """What experiments there are, each a point of the unit cube: the genes of every input, then the constants.

    Attributes:
        time: of all experiments, from zero, s.
        inputs: `[input, 2]` limits of each.
        constants: name -> least and most of each constant that can be changed.

    """

    time: Float[Any, " time"]
    inputs: Float[Any, "input 2"]
    constants: dict[str, Float[Any, "2"]]

    @property
    def genes(self) -> int:
        """Coordinates of an experiment."""
        return commands.GENES * len(self.inputs) + len(self.constants)


def realised(
    space: Space, individuals: Float[Any, "experiment gene"]
) -> tuple[Float[Any, "experiment time input"], dict[str, Float[Any, " experiment"]]]:
    """Return the inputs and the constants of experiments."""
    size, number = commands.GENES, len(space.inputs)

    def command(genes, limits):
        return commands.command(genes, space.time, limits[0], limits[1])

    by_input = individuals[:, : size * number].reshape(-1, number, size)
    inputs = jax.vmap(jax.vmap(command), (0, None))(by_input, space.inputs)
    rest = individuals[:, size * number :]
    constants = {n: pair[0] + rest[:, k] * (pair[1] - pair[0]) for k, (n, pair) in enumerate(space.constants.items())}
    return jnp.moveaxis(inputs, 1, 2), constants


def plain(space: Space, so_far: Mapping[str, float]) -> Float[np.ndarray, "experiment gene"]:
    """Return plain experiments: every kind of command, all inputs alike, one constant at most at an end of its range.

    Args:
        space: what there is.
        so_far: value of each constant in the records so far; those within their range come first.

    """
    shares = {n: (so_far[n] - low) / (high - low) for n, (low, high) in space.constants.items()}
    usual = np.clip(np.array(list(shares.values())), 0.0, 1.0)
    settings = [usual] + [np.where(np.arange(len(usual)) == k, end, usual) for k in range(len(usual)) for end in (0, 1)]
    return np.array([
        np.concatenate([*[_plain_command(kind, amplitude, hold)] * len(space.inputs), values])
        for values in settings
        for kind, amplitude, hold in itertools.product(range(len(commands.KINDS)), _AMPLITUDES, _HOLDS)
    ])  # fmt: skip


def _plain_command(kind: int, amplitude: float, hold: float) -> list[float]:
    return [(kind + 0.5) / len(commands.KINDS), amplitude, 0.5, hold, 0.5, *_LEVELS]


def kind_of(genes: Float[np.ndarray, " gene"]) -> int:
    """Return the kind of the first input's command."""
    return int(genes[0] * len(commands.KINDS))


def as_record(space: Space, genes: Float[np.ndarray, " gene"], model: Model, so_far: Record) -> tuple[Record, str]:
    """Return an experiment as a record without outputs, held and known otherwise as one so far, and in words."""
    inputs, words = {}, []
    for k, (name, (lower, upper)) in enumerate(zip(model.inputs, space.inputs, strict=True)):
        own = genes[k * commands.GENES : (k + 1) * commands.GENES]
        inputs[name] = commands.realised(own, space.time, lower, upper)
        in_unit = functools.partial(quantity, unit=model.unit(name))
        words.append(f"{name}: {commands.described(own, space.time, lower, upper, in_unit)}")
    rest, constants = genes[len(space.inputs) * commands.GENES :], dict(so_far.constants)
    for (name, (lower, upper)), share in zip(space.constants.items(), rest, strict=True):
        constants[name] = float(lower + share * (upper - lower))
        words.append(f"{name} {quantity(constants[name], model.parameter(name).unit)}")
    words.append(f"{space.time[-1]:.4g} s")
    return Record(space.time, inputs, hold=so_far.hold, constants=constants, name="next"), "; ".join(words)
