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
from ehsvjax.experiment.commands import Reach
from ehsvjax.models.model import Model
from ehsvjax.quantities import quantity
from ehsvjax.record import Record

# Genes of plain commands: every kind at these amplitudes and time scales, in the middle of its limits, of fixed levels.
_AMPLITUDES, _HOLDS = (1.0, 0.5), (0.45, 0.8)
_LEVELS = (0.03, 0.91, 0.37, 0.66, 0.15, 0.82, 0.47, 0.99, 0.28, 0.72, 0.09, 0.58)


class Space(NamedTuple):
    """What experiments there are: records, each a point of the unit cube, the genes of every input, then the constants.

    Attributes:
        time: of every record, from zero, s.
        inputs: `[input]` what each can do.
        constants: name -> least and most of each constant that can be changed.

    """

    time: Float[Any, " time"]
    inputs: Reach
    constants: dict[str, Float[Any, "2"]]

    @property
    def number(self) -> int:
        """Count the inputs."""
        return len(self.inputs.lower)

    @property
    def genes(self) -> int:
        """Coordinates of a record."""
        return commands.GENES * self.number + len(self.constants)


def realised(
    space: Space, individuals: Float[Any, "experiment gene"]
) -> tuple[Float[Any, "experiment record time input"], dict[str, Float[Any, "experiment record"]]]:
    """Return the inputs and the constants of experiments, each of as many records as there are genes for."""
    by_record = individuals.reshape(len(individuals), -1, space.genes)
    by_input = by_record[..., : commands.GENES * space.number].reshape(*by_record.shape[:2], space.number, -1)
    each = jax.vmap(commands.command, (0, None, 0), out_axes=1)
    inputs = jax.vmap(jax.vmap(each, (0, None, None)), (0, None, None))(by_input, space.time, space.inputs)
    rest = by_record[..., commands.GENES * space.number :]
    constants = {n: pair[0] + rest[..., k] * (pair[1] - pair[0]) for k, (n, pair) in enumerate(space.constants.items())}
    return inputs, constants


def plain(space: Space, so_far: Mapping[str, float], records: int) -> Float[np.ndarray, "experiment gene"]:
    """Return plain experiments: every kind of command, all inputs alike, one constant at most at an end of its range.

    Several records of one are alike but for that: the first has all constants as in the records so far. Where none can
    be changed, each is half as large as the one before.

    Args:
        space: what there is.
        so_far: value of each constant in the records so far; those within their range come first.
        records: of every experiment.

    """
    shares = {n: (so_far[n] - low) / (high - low) for n, (low, high) in space.constants.items()}
    usual = np.clip(np.array(list(shares.values())), 0.0, 1.0)
    settings = [usual] + [np.where(np.arange(len(usual)) == k, end, usual) for k in range(len(usual)) for end in (0, 1)]

    def of_each_record(values):
        if records > 1 and not space.constants:
            return [(0.5**k, values) for k in range(records)]
        return [(1.0, usual)] * (records > 1) + [(1.0, values)] * max(records - 1, 1)

    return np.array([
        np.concatenate([part for factor, values in of_each_record(setting) for part in (command(factor), values)])
        for setting in settings
        for command in _plain_commands(space)
    ])  # fmt: skip


def _plain_commands(space: Space):
    """Return for each plain command a function that gives the genes of all inputs, its size times a factor."""

    def of_kind(kind, amplitude, hold):
        place = (kind + 0.5) / len(space.inputs.kinds)
        return lambda factor: np.tile([place, factor * amplitude, 0.5, hold, 0.5, *_LEVELS], space.number)

    found = [of_kind(*one) for one in itertools.product(range(len(commands.KINDS)), _AMPLITUDES, _HOLDS)]
    if space.inputs.own is not None:
        sizes = [commands.of_own_size(reach_of(space, k)) for k in range(space.number)]
        place = 1.0 - 0.5 / len(space.inputs.kinds)
        found.append(
            lambda factor: np.concatenate([[place, factor * size, at, 0.5, 0.5, *_LEVELS] for size, at in sizes])
        )
    return found


def reach_of(space: Space, k: int) -> Reach:
    """Return what one input can do."""
    return jax.tree.map(lambda leaf: leaf[k], space.inputs)


def kind_of(space: Space, genes: Float[np.ndarray, " gene"]) -> int:
    """Return the kind of the first input's command in the first record."""
    return int(commands.kind_of(jnp.asarray(genes), space.inputs))


def as_records(
    space: Space, genes: Float[np.ndarray, " gene"], model: Model, so_far: Record
) -> tuple[tuple[Record, ...], str]:
    """Return an experiment as records without outputs, held and known otherwise as one so far, and in words."""
    several = genes.reshape(-1, space.genes)
    names = ["next"] if len(several) == 1 else [f"next {k}" for k in range(1, len(several) + 1)]
    made = [_as_record(space, own, model, so_far, name) for own, name in zip(several, names, strict=True)]
    words = [said if len(made) == 1 else f"record {k}: {said}" for k, (_, said) in enumerate(made, 1)]
    return tuple(record for record, _ in made), "; ".join(words)


def _as_record(space: Space, genes, model: Model, so_far: Record, title: str) -> tuple[Record, str]:
    inputs, words = {}, []
    for k, name in enumerate(model.inputs):
        own, reach = genes[k * commands.GENES : (k + 1) * commands.GENES], reach_of(space, k)
        inputs[name] = commands.realised(own, space.time, reach)
        in_unit = functools.partial(quantity, unit=model.unit(name))
        words.append(f"{name}: {commands.described(own, space.time, reach, in_unit)}")
    rest, constants = genes[space.number * commands.GENES :], dict(so_far.constants)
    for (name, (lower, upper)), share in zip(space.constants.items(), rest, strict=True):
        constants[name] = float(lower + share * (upper - lower))
        words.append(f"{name} {quantity(constants[name], model.parameter(name).unit)}")
    words.append(f"{space.time[-1]:.4g} s")
    return Record(space.time, inputs, hold=so_far.hold, constants=constants, name=title), "; ".join(words)
