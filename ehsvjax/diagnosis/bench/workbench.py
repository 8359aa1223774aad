"""The model with every candidate effect attached at once, each absent: one program for all that is tried.

A point is a row of coordinates: those of the model's free parameters, then those of every effect's numbers, then those
of the initial conditions. What is tried differs in its data only, so that nothing is compiled twice.
"""

import functools
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ehsvjax import arithmetic, kernels
from ehsvjax.effects.effect import UNLIMITED, Candidate, EffectParameter, Scales, constant_of
from ehsvjax.effects.extended import switches
from ehsvjax.effects.internal import Internal
from ehsvjax.fit import Fit
from ehsvjax.models.model import Model
from ehsvjax.population import Coordinates, Problem, cast, simulated, to_unit, to_values
from ehsvjax.record import Record

ABREAST = 8
"""Simulated side by side: so few that a handful of points keeps all cores busy."""
AT_ONCE = ABREAST * (os.cpu_count() or 1)
"""Simulated by all cores together: what is made in such portions takes little memory, however long a record is."""
ROUNDING = 3e-14
"""Of the outputs: a smaller change is none."""
TOLD_APART = 3e-5
"""Part of derivatives, relative to the largest, below which differences cannot tell them from zero."""


@dataclass(frozen=True, eq=False)
class Workbench:
    """A fit and records, ready for trials.

    Attributes:
        fit: the fit that is diagnosed.
        records: on which.
        model: its model with every candidate attached, and with disturbances.
        problem: of that model and the records, in NumPy float64; an effect's number has its scale as unit.
        candidates: the effects at signals of the model.
        scales: of each candidate.
        internal: what runs along the nominal model's signals, `[record, time]`.
        places: signals that can be disturbed by a series.
        probes: place -> a disturbance, in the signal's unit, that moves the outputs by a little.
        disturbances: `[record, time, place]` what is added to them in every simulation; nothing at first.
        column: name of an unknown -> its column; of what each record has for itself, `name[record]`.
        nominal: `[parameter]` the point at which every effect is absent.
        differences: `[parameter]` of coordinates, for derivatives.
        sketched_at: integration steps per sample that know most readings: enough to see where a cause points.

    """

    fit: Fit
    records: tuple[Record, ...]
    model: Model
    problem: Problem
    candidates: tuple[Candidate, ...]
    scales: dict[str, Scales]
    internal: Internal
    places: tuple[str, ...]
    probes: dict[str, float]
    disturbances: Float[np.ndarray, "record time place"]
    column: dict[str, int]
    nominal: Float[np.ndarray, " parameter"]
    differences: Float[np.ndarray, " parameter"]
    sketched_at: int

    @functools.cached_property
    def base_columns(self) -> list[int]:
        """Columns of the nominal model's unknowns, initial conditions included."""
        own = {j for c in self.candidates for j in self.columns_of(c)}
        return [j for j in range(len(self.nominal)) if j not in own]

    @functools.cached_property
    def present(self) -> Bool[np.ndarray, "record time"]:
        """Where the records have samples: the shorter ones are filled up."""
        lengths = np.array([len(record) for record in self.records])
        return np.arange(self.problem.samples.inputs.shape[1]) < lengths[:, None]

    @property
    def clock(self) -> Float[np.ndarray, "record time"]:
        """The time in s since the start of each record."""
        return np.arange(self.problem.samples.inputs.shape[1]) * self.problem.samples.sample_period[:, None]

    def unknowns_of(self, candidate: Candidate) -> list[tuple[EffectParameter, int]]:
        """Return an effect's numbers, each with its column; one that is of its run once for every record."""
        found = []
        for number in candidate.effect.parameters:
            name = candidate.parameter(number.name)
            each = [name] if name in self.column else [f"{name}[{k}]" for k in range(len(self.records))]
            found += [(number, self.column[one]) for one in each]
        return found

    @functools.cached_property
    def bounds(self) -> tuple[Float[np.ndarray, " parameter"], Float[np.ndarray, " parameter"]]:
        """The least and the largest coordinate of every unknown."""
        lower, upper = np.zeros(len(self.nominal)), np.ones(len(self.nominal))
        for candidate in self.candidates:
            scales = self.scales[candidate.name]
            for number, j in self.unknowns_of(candidate):
                low, high = number.lower(scales), number.upper(scales)
                lower[j] = -np.inf if low <= -UNLIMITED else self.coordinate(low, j)
                upper[j] = np.inf if high >= UNLIMITED else self.coordinate(high, j)
        return lower, upper

    def columns_of(self, candidate: Candidate) -> list[int]:
        """Columns of an effect's numbers."""
        return [j for _, j in self.unknowns_of(candidate)]

    def columns_with(self, included: Sequence[int]) -> list[int]:
        """Columns of the nominal model's unknowns and of some candidates' numbers, by their positions.

        Of a parameter that is another in every record, or another than its bounds allow, there is none besides: it does
        the same.
        """
        some = [self.candidates[i] for i in included]
        replaced = {j for c in some for j in self._replaced_by(c)}
        base = [j for j in self.base_columns if j not in replaced]
        return [*base, *(j for c in some for j in self.columns_of(c))]

    def of_each(self, candidate: int) -> bool:
        """Whether a candidate, by its position, is something that each of several records has for itself."""
        return len(self.records) > 1 and self.candidates[candidate].effect.of_run

    def numbers_of(self, candidate: int) -> int:
        """How many numbers more the effect of a candidate has than the model without it."""
        there = self.candidates[candidate]
        return len(self.columns_of(there)) - len(self._replaced_by(there))

    def _replaced_by(self, candidate: Candidate) -> list[int]:
        """Columns of the nominal model's unknowns for which an effect's numbers stand."""
        name = constant_of(candidate.effect)
        return [self.column[name]] if candidate.effect.kind == "constant" and name in self.column else []

    def search_of(self, candidate: int) -> float:
        """Noise variances that chance gains by a search for a frequency, where a candidate has one.

        The largest of so many squares of two numbers each; 0 where nothing is searched.
        """
        frequencies = self.problem.samples.measured.sum() / 2
        return float(2.0 * np.log(frequencies)) if self.candidates[candidate].effect.harmonic else 0.0

    def value(self, point: Float[np.ndarray, " parameter"], column: int) -> float:
        """Value of one unknown at a point, SI."""
        # Of what leaves no trace, any amount: it may be infinite.
        with np.errstate(over="ignore"):
            return to_values(self._coordinates_of(column), point[[column]]).item()

    def coordinate(self, value: float, column: int) -> float:
        """Coordinate of one unknown that has this value, SI."""
        return to_unit(self._coordinates_of(column), np.array([value], float)).item()

    def value_by_coordinate(self, point: Float[np.ndarray, " parameter"], column: int) -> float:
        """Derivative of the value of one unknown by its coordinate at a point, SI."""
        lower, upper, logarithmic, offset = (each.item() for each in self._coordinates_of(column))
        if not logarithmic:
            return upper - lower
        return (self.value(point, column) + offset) * math.log((upper + offset) / (lower + offset))

    def _coordinates_of(self, column: int) -> Coordinates:
        return Coordinates(*(each[[column]] for each in self.problem.coordinates))

    def simulated(
        self,
        points: Float[np.ndarray, "individual parameter"],
        disturbances: Float[np.ndarray, "individual record time place"] | None = None,
        substeps: int | None = None,
    ) -> Float[np.ndarray, "individual record time signal"]:
        """Return the outputs of each point, SI, with what is added to signals while they run, beside what always is.

        At the bench's integration steps per sample, or at others.
        """
        here = self.problem.substeps if substeps is None else substeps
        problem = replace(self._on_device, substeps=np.int32(here))

        every = np.empty((len(points), *problem.samples.outputs.shape))

        def simulate(first: int) -> None:
            some = points[first : first + ABREAST]
            added: Any = self._always_added
            if disturbances is not None:
                added = np.array(added)
                added[: len(some)] += disturbances[first : first + ABREAST]
            # The setting is that of a thread.
            with kernels.double_precision():
                filled = jnp.asarray(_filled(some, ABREAST))
                acting = replace(problem, known=problem.known | self._acting(some))
                outputs = _simulated(acting, filled, jnp.asarray(added))
                every[first : first + ABREAST] = np.asarray(outputs)[: len(some)]

        # Taking the results raises what a simulation has raised.
        list(_threads().map(simulate, range(0, len(points), ABREAST)))
        # What comes after the end of a record is nothing, whatever the model would do there.
        every[:, ~self.present] = 0.0
        return every

    def _acting(self, points: Float[np.ndarray, "individual parameter"]) -> dict[str, np.float64]:
        """Return for each switch of the model whether some of the points have an effect there."""
        present = np.any(points != self.nominal, axis=0)
        return {name: np.float64(present[columns].any()) for name, columns in self._sizes_at.items()}

    @functools.cached_property
    def _sizes_at(self) -> dict[str, list[int]]:
        """Columns of the numbers that make effects vanish, by the switch that skips these effects."""
        return {
            name: [j for c in some for number, j in self.unknowns_of(c) if number.absent is not None]
            for name, some in switches(self.candidates).items()
        }

    @functools.cached_property
    def _always_added(self) -> Float[Array, "individual record time place"]:
        """What is added to signals in every simulation, side by side; to copy it takes as long as some simulations."""
        with kernels.double_precision():
            return jnp.asarray(np.repeat(self.disturbances[None], ABREAST, axis=0))

    @functools.cached_property
    def _on_device(self) -> Problem:
        """The problem in double precision: to copy it for every simulation would take as long as some of them.

        How many integration steps a sample had in the fit is nothing that another program has to be compiled for.
        """
        with kernels.double_precision():
            return cast(replace(self.problem, grid=self.problem.grid._replace(substeps=1)), jnp.float64)

    def stepped(self, points: Float[np.ndarray, "individual parameter"]) -> arithmetic.OutputsAt:
        """Return the outputs of some points by integration steps per sample, each simulated once."""
        return functools.cache(lambda substeps: self.simulated(points, substeps=substeps))

    def sketched(
        self,
        points: Float[np.ndarray, "individual parameter"],
        disturbances: Float[np.ndarray, "individual record time place"] | None = None,
    ) -> Float[np.ndarray, "individual record time signal"]:
        """Return the outputs as `simulated` does, for what is compared with one another only, not with readings."""
        return self.simulated(points, disturbances, self.sketched_at)

    def responses(
        self,
        point: Float[np.ndarray, " parameter"],
        count: int,
        disturbance: Callable[[int], Float[np.ndarray, "record time place"]],
    ) -> Float[np.ndarray, "disturbance record time signal"]:
        """Return what each of so many disturbances changes in the outputs of a point, sketched.

        Nothing is known of one that lets the model run away: near a hill of its potential any push may be too large.

        They are made as they are simulated: of a long record all at once would take more memory than what they do.
        """
        here = self.sketched(point[None])[0]
        # Single precision is far more than sketches are worth.
        changes = np.empty((count, *here.shape), np.float32)
        for first in range(0, count, AT_ONCE):
            rows = range(first, min(first + AT_ONCE, count))
            added = np.stack([disturbance(row) for row in rows])
            changed = self.sketched(np.repeat(point[None], len(rows), axis=0), added) - here
            changes[first : rows.stop] = known_alone(changed)
        return changes

    def linearised(
        self, points: Float[np.ndarray, "individual parameter"], chosen: Int[np.ndarray, "individual direction"]
    ):
        """Return outputs `[individual, record, time, signal]` and their derivatives `[direction, individual, ...]`.

        The derivatives are differences, right to some 1e-5 of each, 1e-3 of an effect that hardly shows: what is
        derived is simulated as everything else, and nothing more is compiled.

        Args:
            points: where.
            chosen: columns along which to differentiate; -1 gives zero.

        """
        individual, direction = np.nonzero(chosen >= 0)
        columns = chosen[individual, direction]
        moved = points[individual]
        moved[np.arange(len(moved)), columns] += self.differences[columns]
        every = self.simulated(np.concatenate([points, moved]))
        outputs, changed = every[: len(points)], every[len(points) :]
        slopes = np.zeros((chosen.shape[1], *outputs.shape))
        slopes[direction, individual] = self.derivatives(outputs[individual], changed, columns)
        return outputs, slopes

    def derivatives(
        self,
        outputs: Float[np.ndarray, "direction record time signal"],
        changed: Float[np.ndarray, "direction record time signal"],
        columns: Int[np.ndarray, " direction"] | Sequence[int],
    ) -> Float[np.ndarray, "direction record time signal"]:
        """Return derivatives, from the outputs at points and at those moved by `differences` along columns."""
        # Where neither can be simulated there is none either: NaN, without a warning.
        with np.errstate(invalid="ignore"):
            change = changed - outputs
        # What a dead zone hides has no derivative; rounding must not give it one.
        largest = np.max(np.abs(outputs), axis=(1, 2, 3))
        change[np.max(np.abs(change), axis=(1, 2, 3)) < ROUNDING * largest] = 0.0
        return change / self.differences[columns, None, None, None]


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Return one thread for each core. They stay: what a new one has to set up takes as long as some simulations."""
    return ThreadPoolExecutor(os.cpu_count())


def duration_of(records: Sequence[Record]) -> float:
    """Return over how many s drifts are counted: the longest record."""
    return max(len(record) * record.sample_period for record in records)


def prepared(bench: Workbench) -> Workbench:
    """Return the bench at the step that the nominal model needs, and at the one at which its trials are sketched."""
    return settled(bench, bench.stepped(bench.nominal[None]), bench.problem.noise_variance)


def settled(
    bench: Workbench, outputs_at: arithmetic.OutputsAt, noise_variance: Float[np.ndarray, "*record signal"]
) -> Workbench:
    """Return the bench at a step at which its simulations (`stepped`) are as good as exact; itself if it is there.

    Readings that no such step knows are no longer measured. The step at which trials are sketched, where most readings
    are as good as exact, follows too: with other parameters a model may be stiff, and a sketch of it chatter.
    """
    sketched = replace(bench.problem, substeps=np.int32(bench.sketched_at))
    # Beside what is wrong with the fit, whatever the noise is found to be.
    rough = arithmetic.arithmetic(sketched, outputs_at, bench.problem.noise_variance, arithmetic.ROUGHLY)
    problem = arithmetic.settled(bench.problem, outputs_at, noise_variance)
    if problem is bench.problem and rough.substeps == bench.sketched_at:
        return bench
    return replace(bench, problem=problem, sketched_at=rough.substeps)


def known_alone(
    changes: Float[np.ndarray, "change record time signal"],
) -> Float[np.ndarray, "change record time signal"]:
    """Return changes of the outputs, nothing in the place of those that run away: they tell of no direction.

    Squares of what is kept are finite in single precision, in which sums of them are taken.
    """
    with np.errstate(over="ignore"):
        known = np.isfinite(np.square(changes, dtype=np.float32)).all(axis=(1, 2, 3), keepdims=True)
    return np.where(known, changes, 0.0)


def with_readings(bench: Workbench, measured: Bool[np.ndarray, "record time signal"]) -> Workbench:
    """Return the bench with these readings and no others."""
    samples = bench.problem.samples._replace(measured=measured)
    return replace(bench, problem=replace(bench.problem, samples=samples))


def same_readings(bench: Workbench, other: Workbench) -> bool:
    """Whether two benches have the same readings and steps."""
    steps = [(int(one.problem.substeps), one.sketched_at) for one in (bench, other)]
    measured = [one.problem.samples.measured for one in (bench, other)]
    return steps[0] == steps[1] and bool(np.array_equal(*measured))


def _filled(rows, count):
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])


def _disturbed(problem: Problem, point, added) -> Float[Array, "record time signal"]:
    count = added.shape[-1]
    inputs = problem.samples.inputs
    inputs = inputs.at[..., inputs.shape[-1] - count :].set(added) if count else inputs
    return simulated(replace(problem, samples=problem.samples._replace(inputs=inputs)), point)


@kernels.jit
def _simulated(problem: Problem, points, added):
    return jax.vmap(functools.partial(_disturbed, problem))(points, added)
