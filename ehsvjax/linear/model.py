"""A linear model: its matrices, and what an engineer asks of it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Complex, Float

if TYPE_CHECKING:
    import matplotlib.figure
    import scipy.signal

# Standard deviations of the parameters to either side, by which a deviation of the response is told.
ASIDE = 0.1


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Small deviations from an operating point: x' = A x + B u, y = C x + D u. Made by `linearise`.

    Attributes:
        a, b, c, d: the matrices, in the units of the states, inputs and outputs, and seconds.
        states: names of the states; what follows them at once is none.
        inputs: names of what acts: inputs, and signals to which something is added.
        outputs: names of what is seen.
        point: name -> value of inputs, states and outputs at the operating point, SI.
        beside: the same at `ASIDE` standard deviations to either side, along each independent direction in which the
            parameters of a fit are uncertain, as far as the record fixes them; empty for a model.

    """

    a: Float[np.ndarray, "state state"]
    b: Float[np.ndarray, "state input"]
    c: Float[np.ndarray, "output state"]
    d: Float[np.ndarray, "output input"]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    point: dict[str, float]
    beside: "tuple[tuple[LinearModel, LinearModel], ...]" = ()

    @property
    def system(self) -> "scipy.signal.StateSpace":
        """It as SciPy knows it; python-control's `ss(linear.a, linear.b, linear.c, linear.d)` takes the matrices."""
        import scipy.signal

        return scipy.signal.StateSpace(self.a, self.b, self.c, self.d)

    @property
    def poles(self) -> Complex[np.ndarray, " state"]:
        """The poles, rad/s, the slowest first."""
        poles = np.linalg.eigvals(self.a).astype(complex)
        return poles[np.lexsort((poles.imag, np.round(np.abs(poles), 9)))]

    @property
    def lasting(self) -> Float[np.ndarray, "output input"]:
        """What each output comes to for each input that stays off by one unit; NaN where that does not settle."""
        values, vectors = np.linalg.eig(self.a)
        into, out_of = np.linalg.solve(vectors, self.b.astype(complex)), self.c @ vectors
        settles = values.real < 0.0
        gain = self.d - ((out_of / np.where(settles, values, 1.0))[:, settles] @ into[settles]).real
        size = np.abs(out_of[:, ~settles]) @ np.abs(into[~settles])
        return np.where(size > 1e-9 * np.abs(gain), np.nan, gain)

    def response(self, frequency: Float[np.ndarray, " frequency"]) -> Complex[np.ndarray, "frequency output input"]:
        """Return the frequency response C (jw - A)^-1 B + D.

        Args:
            frequency: rad/s.

        """
        shifted = 1j * np.asarray(frequency, float)[:, None, None] * np.eye(len(self.a)) - self.a
        return (
            self.c @ np.linalg.solve(shifted, np.broadcast_to(self.b, (*shifted.shape[:2], self.b.shape[1]))) + self.d
        )

    def deviation(self, frequency: Float[np.ndarray, " frequency"]) -> Complex[np.ndarray, "frequency output input"]:
        """Return standard deviations of the logarithm of the response: of its size, and 1j times of its phase, rad.

        To first order, from `beside`; zero for a model, whose parameters are known.

        Args:
            frequency: rad/s.

        """
        nothing = np.zeros((len(frequency), len(self.outputs), len(self.inputs)))
        sides = [(up.response(frequency), down.response(frequency)) for up, down in self.beside]
        # What does not answer at all does so with certainty.
        ratios = [np.divide(up, down, out=np.ones_like(up), where=(up != 0.0) & (down != 0.0)) for up, down in sides]
        changes = [np.log(ratio) / (2.0 * ASIDE) for ratio in ratios]
        return np.sqrt(sum((c.real**2 for c in changes), nothing)) + 1j * np.sqrt(
            sum((c.imag**2 for c in changes), nothing)
        )

    def plot_bode(self) -> "matplotlib.figure.Figure":
        """Draw size and phase of the response from every input to every output, with the band that holds 95%."""
        from ehsvjax.plots import plot_bode

        return plot_bode(self)

    def __str__(self) -> str:
        """The operating point, poles with their frequency and damping, and what a lasting deviation comes to."""
        from ehsvjax.summary import linear_summary

        return linear_summary(self)

    __repr__ = __str__
