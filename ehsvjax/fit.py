"""The result of an identification: parameters, how well they fit, and what can be asked of them next."""

import functools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.checks import by_name, choice, number, refused
from ehsvjax.failure import warn_of_failure
from ehsvjax.models.model import Model, tied_values
from ehsvjax.record import Record, checked_record
from ehsvjax.score import Score, differences, score_of
from ehsvjax.simulate import simulate

if TYPE_CHECKING:
    import matplotlib.figure
    import pandas
    from jaxtyping import Array, Key

    from ehsvjax.effects import Effect
    from ehsvjax.linear import LinearModel
    from ehsvjax.precision import Band, Bootstrap, Precision, ProfileLikelihood
    from ehsvjax.precision.of_fit import Prepared


class History(NamedTuple):
    """What the search went through, generation by generation (`[generation]`, as many as were run).

    Attributes:
        best_cost: of the best so far: the sum of squared residuals in noise variances.
        median_cost: of the generation; +inf where more than half of its simulations failed.
        failed: share of the generation whose simulation failed.
        spread: largest standard deviation over the unknowns of the better half, as a share of the bounds' interval.
        best: name -> `[generation]`, the best parameters so far, SI.

    """

    best_cost: Float[np.ndarray, " generation"]
    median_cost: Float[np.ndarray, " generation"]
    failed: Float[np.ndarray, " generation"]
    spread: Float[np.ndarray, " generation"]
    best: dict[str, Float[np.ndarray, " generation"]]


EXPLAINS_NOTHING = "the model explains nothing of"
"""How the warning begins that comes before everything else."""


def at_bounds(model: Model, parameters: Mapping[str, float]) -> list[tuple[str, str]]:
    """Return the free parameters that are at a bound, each with its side, "lower" or "upper"."""
    found = []
    for name in model.free:
        p = model.parameter(name)
        for side, bound in (("lower", p.lower), ("upper", p.upper)):
            size = abs(bound) if p.scale == "log" else p.upper - p.lower
            if abs(parameters[name] - bound) < 1e-6 * size:
                found.append((name, side))
    return found


def at_bound(name: str, side: str, what: str = "") -> str:
    """Return the warning of a fit whose parameter is at its "lower" or "upper" bound."""
    return f"{name} is at its {side} bound{what}: widen bounds={{{name!r}: ...}} or fix it"


class Effort(NamedTuple):
    """What was done for a fit.

    Attributes:
        population, generations: sizes of the search as it was run.
        stopped_early: whether the stop test ended it.
        simulations: by the search, one for each individual and generation.
        refined: whether a gradient refinement followed.
        iterations: steps of the refinement from the best start, of the last round of weighting.
        starts: how many points were refined.
        starts_agreeing: how many of them led to the same minimum.
        converged: whether the refinement has, by its own test; without refinement, whether the search's stop test has.
        remaining: noise variances by which another step would still lower the sum of squares, to first order.
        step_size: of the integration, s: the model's `max_step`, or what the arithmetic needed; None if unknown.
        arithmetic: noise variances that the error of integration is worth; None if it was not measured.
        left_out: readings that no useful step knows, such as those beside a jump of a pressure: they carry no weight.

    """

    population: int
    generations: int
    stopped_early: bool
    simulations: int
    refined: bool
    iterations: int
    starts: int
    starts_agreeing: int
    converged: bool
    remaining: float
    step_size: float | None = None
    arithmetic: float | None = None
    left_out: int = 0


@dataclass(frozen=True, eq=False)
class Fit:
    """A model with the parameters that fit the records best. Made by `identify`.

    Attributes:
        model: the model, with the bounds and fixed values that were used.
        records: the records that it was fitted to.
        parameters: name -> value of the identified parameters, SI.
        initial: for each record, name -> value of all initial conditions, SI.
        noise_variance: name of the output -> variance by which its residuals were weighted, unit squared: given, or the
            mean square of the residuals themselves.
        history: of the search.
        effort: what was done.
        warnings: what a user should know before trusting the numbers; empty if nothing.
        huber: residuals beyond this many standard deviations weigh linearly; None: all are squared.
        estimated_initial: names of the initial conditions that were estimated; the others were known.
        noise_variance_given: whether the noise variance was given.

    """

    model: Model
    records: tuple[Record, ...]
    parameters: dict[str, float]
    initial: tuple[dict[str, float], ...]
    noise_variance: dict[str, float]
    history: History
    effort: Effort
    warnings: tuple[str, ...]
    huber: float | None = None
    estimated_initial: tuple[str, ...] = ()
    noise_variance_given: bool = False

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs that were fitted."""
        return tuple(self.noise_variance)

    @functools.cached_property
    def tied(self) -> dict[str, float]:
        """Name -> value of each parameter that follows others, SI."""
        return tied_values(self.model.ties, self.model.nominal | self.parameters)

    @property
    def cost(self) -> float:
        """Equation (9) of the paper, the integral of the squared error, over all records.

        With one output in its unit squared times s; with several, each is divided by its noise variance, in s.
        """
        costs = self._score.cost
        if len(costs) == 1:
            return next(iter(costs.values()))
        return sum(cost / self.noise_variance[name] for name, cost in costs.items())

    @property
    def rmse(self) -> dict[str, float]:
        """Root of the mean squared error of each output over all records, in its unit."""
        return self._score.rmse

    @property
    def fit_percent(self) -> dict[str, float]:
        """Fit of each output over all records, MATLAB's 100*(1 - NRMSE) with the mean removed."""
        return self._score.fit_percent

    def simulate(
        self, record: Record, initial: Mapping[str, float] | str = "estimate"
    ) -> dict[str, Float[np.ndarray, " time"]]:
        """Simulate the fitted model over a record's inputs.

        Args:
            record: one that was fitted, or a new one.
            initial: for a record that was fitted, its own initial conditions; for a new one they are first
                "estimate"d from its outputs with the parameters held (but for those that were known alike for every
                record of the fit), or taken as "nominal", or given by name.

        Returns:
            every output of the model by name, `[time]`, SI; a `RuntimeWarning` says where it is not finite.

        Raises:
            ValueError: for what is no record, one that lacks an input, or one without an output to estimate initial
                conditions from.

        """
        simulated = simulate(self.model, record, self.parameters_of(record), self.initial_of(record, initial))
        warn_of_failure(self.model, record, simulated)
        return simulated

    def residuals(
        self, record: Record | None = None, initial: Mapping[str, float] | str = "estimate"
    ) -> dict[str, Float[np.ndarray, " time"]]:
        """Measured minus simulated of each output that the record holds, `[time]`, SI.

        NaN for missing readings, +inf for those where the simulation is not finite: no model is good where it fails.

        Args:
            record: by default the first that was fitted.
            initial: as for `simulate`.

        Raises:
            ValueError: as `simulate` does, and for an output that the model does not have.

        """
        record = self.records[0] if record is None else checked_record(record)
        unknown = [name for name in record.outputs if name not in self.model.outputs]
        if unknown:
            raise ValueError(
                f"expected the outputs of {record.name} to be among those of {self.model.name}, "
                f"{', '.join(self.model.outputs)}; got {', '.join(unknown)}: name its columns accordingly, or drop "
                "them with .select"
            )
        simulated = self.simulate(record, initial)
        return {name: differences(measured, simulated[name]) for name, measured in record.outputs.items()}

    def score(self, record: Record, initial: Mapping[str, float] | str = "estimate") -> Score:
        """Judge the prediction of one record, fitted or new; arguments and refusals as for `residuals`."""
        return score_of([checked_record(record)], [self.residuals(record, initial)])

    def parameters_of(self, record: Record) -> dict[str, float]:
        """Return the parameters, name -> value, with which `simulate` runs a record, SI.

        What is of a run, a drift or a disturbance that goes by the clock, is absent in a record that was not fitted.
        """
        if any(record is fitted for fitted in self.records):
            return self.parameters
        return self.parameters | {n: v for n, v in self.model.of_run.items() if n in self.parameters}

    @functools.cached_property
    def _score(self) -> Score:
        return score_of(self.records, [self.residuals(record) for record in self.records])

    def initial_of(self, record: Record, initial: Mapping[str, float] | str = "estimate") -> dict[str, float]:
        """Return the initial conditions, name -> value, with which `simulate` starts; arguments as there.

        Estimating those of a new record is a small fit of its own: give the result back as `initial` to do it once.

        Raises:
            ValueError: as `simulate` does.

        """
        checked_record(record)
        nominal = {p.name: p.value for p in self.model.initial}
        if isinstance(initial, Mapping):
            given = by_name("initial conditions", initial, "{'initial_position': 0.0}")
            for name in given:
                if name not in nominal:
                    known = ", ".join(nominal) or "none"
                    raise ValueError(
                        f"expected an initial condition of {self.model.name}, got {name!r}; it has {known}"
                    )
            return nominal | {name: number(name, v, remedy="give its value, SI") for name, v in given.items()}
        if not isinstance(initial, str) or initial not in ("estimate", "nominal"):
            raise refused("initial", "'estimate', 'nominal' or values by name", initial, "choose one")
        if initial == "nominal":
            return nominal
        for fitted, values in zip(self.records, self.initial, strict=True):
            if fitted is record:
                return values
        from ehsvjax.identify import estimate_initial

        return estimate_initial(self, record)

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard deviation of each parameter, SI; +inf for one that the records do not fix. See `precision`."""
        return self.precision().standard_errors

    @property
    def correlations(self) -> dict[tuple[str, str], float]:
        """Correlation of each pair of parameters that the records fix. See `precision`."""
        return self.precision().correlations

    def precision(self, noise: str = "auto") -> "Precision":
        """Return how sure the parameters are, to first order: errors, correlations, directions that are not fixed.

        From the Fisher information, with sensitivities by forward differentiation in float64, the initial conditions
        that were estimated taken into account. Where the noise variance was not given it is that of the residuals.

        Args:
            noise: "white"; "coloured", for residuals that are correlated (a sandwich with an autoregression of the
                residuals); or "auto": coloured if a Ljung-Box test says that they are.

        Raises:
            ValueError: for another noise.

        """
        from ehsvjax.precision import of_fit

        return of_fit.precision(self, self._prepared(noise))

    def profile_likelihood(
        self, names: Sequence[str] | None = None, *, level: float = 0.95, noise: str = "auto"
    ) -> "ProfileLikelihood":
        """Return intervals by how the best cost rises as a parameter is held elsewhere; all refits run as one batch.

        Slower than standard errors, and right where the cost is no parabola, or where a parameter is near a bound.

        Args:
            names: of the parameters; by default all that were identified.
            level: of the intervals.
            noise: as for `precision`.

        Raises:
            ValueError: for a parameter that was not identified, a level that is none, or another noise.

        """
        from ehsvjax.precision import of_fit

        return of_fit.profiles(self, self._prepared(noise), names, level)

    def bootstrap(
        self, key: "Key[Array, '']", draws: int = 200, *, kind: str = "parametric", noise: str = "auto"
    ) -> "Bootstrap":
        """Refit records that are drawn anew from the fit, all in one batch.

        Args:
            key: random key, `jax.random.key(0)`.
            draws: how many.
            kind: "parametric" draws Gaussian noise, "block" puts blocks of the residuals together anew.
            noise: of the draws, as for `precision`.

        Raises:
            ValueError: for another kind or noise, or fewer than 2 draws.

        """
        from ehsvjax.precision import of_fit

        return of_fit.draws(self, self._prepared(noise), key, draws, kind)

    def bands(
        self,
        record: Record | None = None,
        initial: Mapping[str, float] | str = "estimate",
        *,
        level: float = 0.95,
        noise: str = "auto",
    ) -> dict[str, "Band"]:
        """Return how far the true output and a new measurement may lie from each simulated output, by its name.

        Args:
            record: by default the first that was fitted.
            initial: as for `simulate`; the errors of those that are estimated count.
            level: of the bands.
            noise: as for `precision`.

        Raises:
            ValueError: if the record holds none of the outputs that were fitted.

        """
        from ehsvjax.precision import of_fit

        return of_fit.bands(self, self._prepared(noise), self.records[0] if record is None else record, initial, level)

    def linearise(
        self,
        at: Mapping[str, float] | None = None,
        *,
        initial: Mapping[str, float] | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        noise: str = "auto",
    ) -> "LinearModel":
        """Return the linear model of small deviations about where the fitted model rests: state space, poles, Bode.

        Args:
            at: the inputs, held constant, by name; those that are not given are zero.
            initial: initial conditions from which it comes to rest, where they differ from the nominal ones, SI.
            inputs: what acts: inputs of the model, or any of its signals; by default the inputs.
            outputs: what is seen: outputs of the model, or any of its signals; by default the outputs.
            noise: as for `precision`; the errors of the parameters make the band of `.plot_bode()`.

        Raises:
            ValueError: as `ehsvjax.linearise` does, and for another noise.

        """
        from ehsvjax.precision import of_fit

        return of_fit.linear(self, self._prepared(noise), at, initial, inputs, outputs)

    def _prepared(self, noise: str) -> "Prepared":
        from ehsvjax.precision import of_fit

        choice("noise", noise, ("auto", "white", "coloured"))
        if noise not in self._prepared_by_noise:
            self._prepared_by_noise[noise] = of_fit.prepared(self, noise)
        return self._prepared_by_noise[noise]

    @functools.cached_property
    def _prepared_by_noise(self) -> dict[str, "Prepared"]:
        return {}

    @property
    def table(self) -> "pandas.DataFrame":
        """All parameters with symbols, values, standard errors, units and bounds, SI, for reports: `.to_latex()`."""
        from ehsvjax.tables import parameter_table

        return parameter_table(self)

    def to_dataframe(
        self, record: Record | None = None, initial: Mapping[str, float] | str = "estimate"
    ) -> "pandas.DataFrame":
        """Return `time` (s), the inputs, and each output as measured, as simulated, and what is left of it, SI.

        Args:
            record: by default the first that was fitted.
            initial: as for `simulate`.

        """
        from ehsvjax.tables import simulation_table

        return simulation_table(self, self.records[0] if record is None else record, initial)

    def plot(self, record: Record | None = None) -> "matplotlib.figure.Figure":
        """Draw measured against simulated, the residual, and the cost by generation; returns the matplotlib figure.

        Args:
            record: by default the first that was fitted.

        """
        from ehsvjax.plots import plot_fit

        return plot_fit(self, self.records[0] if record is None else record)

    def plot_residuals(self, record: Record | None = None) -> "matplotlib.figure.Figure":
        """Draw what is left: its correlations with itself and with every input, with bands, its values, its power.

        Args:
            record: by default the first that was fitted.

        Raises:
            ValueError: for a record without outputs, or on which the simulation fails.

        """
        from ehsvjax.plots import plot_residuals

        return plot_residuals(self, self.records[0] if record is None else record)

    def __str__(self) -> str:
        """Return a summary in lmfit's manner: statistics, parameters with units, warnings."""
        from ehsvjax.summary import summary

        return summary(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        from ehsvjax.summary import summary_html

        return summary_html(self)

    def save(self, path: str | os.PathLike) -> None:
        """Write the fit, its records included, to one NPZ file without pickled content, whole or not at all.

        Raises:
            OSError: if it cannot be written; a file that was there stays as it was.

        """
        from ehsvjax.storage import save_fit

        save_fit(self, path)

    @staticmethod
    def load(path: str | os.PathLike, model: Model | None = None, bank: "Sequence[Effect] | None" = None) -> "Fit":
        """Read a fit that `save` wrote.

        Args:
            path: the file.
            model: needed for a model of your own, as equations are not stored, with or without the effects that the
                fitted one was extended by; those of this package are made again.
            bank: needed for an effect of your own, `(*ehsvjax.effects.BANK, my_effect)`.

        Raises:
            ValueError: if the file holds no fit, was altered, or needs a model or an effect that was not handed over.
            OSError: if the file is not there or may not be read.

        """
        from ehsvjax.storage import load_fit

        return load_fit(path, model, bank)
