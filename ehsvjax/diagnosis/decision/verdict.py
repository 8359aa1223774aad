"""The verdict: adequate, named, ambiguous or unexplained, with the causes and what could be there instead."""

from typing import NamedTuple

import numpy as np

from ehsvjax.diagnosis.bench.readings import lattice
from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.diagnosis.decision.examination import Examination
from ehsvjax.diagnosis.decision.rivals import Rival, inseparable
from ehsvjax.diagnosis.decision.search import Selection

QUANTISATION = "sensor_quantisation"
PROCESS_NOISE = "process_noise"
# Step of the readings' lattice, in deviations of the other noise, beyond which it is a cause.
_COARSEST = 2.2


class Alternative(NamedTuple):
    """Causes that a record cannot tell apart, the best first, and what would: an experiment or a sensor."""

    causes: tuple[str, ...]
    settled_by: str


def verdict_of(examined: Examination) -> tuple[str, tuple[str, ...], tuple[Alternative, ...]]:
    """Return the verdict, the causes and the alternatives."""
    selection = examined.selection
    groups = [
        _names(selection, inseparable(selection.rivals[k])) for k in np.argsort([-gain for gain in selection.gains])
    ]
    if examined.lacking or not (examined.innocent or groups):
        return "unexplained", (), ()
    causes = tuple(group[0] for group in groups) + _quantised(selection)
    causes += (PROCESS_NOISE,) if examined.chance else ()
    if not causes:
        return "adequate", (), ()
    if examined.or_chance:
        # Instead of them all.
        groups = [(*group, PROCESS_NOISE) for group in groups]
    alternatives = tuple(Alternative(g, _settled_by(selection.bench, g)) for g in groups if len(g) > 1)
    return ("ambiguous" if alternatives else "named"), causes, alternatives


def _names(selection: Selection, group: tuple[Rival, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(selection.bench.candidates[r.candidate].name for r in group))


def _quantised(selection: Selection) -> tuple[str, ...]:
    samples, observed = selection.bench.problem.samples, selection.bench.problem.observed
    coarse: dict[str, None] = {}
    for k, noises in enumerate(selection.noise.of):
        for i, name in enumerate(observed):
            step = lattice(samples.outputs[k, :, i][samples.measured[k, :, i]])
            if step is not None and step**2 > _COARSEST**2 * (noises[i].variance - step**2 / 12.0):
                coarse[name] = None
    return tuple(QUANTISATION if len(observed) == 1 else f"{QUANTISATION}@{name}" for name in coarse)


def _settled_by(bench: Workbench, group: tuple[str, ...]) -> str:
    ways = {c.name: c.effect.settled_by for c in bench.candidates if c.effect.settled_by}
    ways[PROCESS_NOISE] = "the same experiment again: chance does not repeat itself"
    return "; ".join(dict.fromkeys(f"{name}: {ways[name]}" for name in group if name in ways))
