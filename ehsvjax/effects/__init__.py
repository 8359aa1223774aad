"""Effects that a model may lack: the bank of candidate causes, and models extended by them."""

from ehsvjax.effects.attach import attach
from ehsvjax.effects.effect import Candidate, Effect, EffectParameter, amplitude, candidates, limit, shape, size, width
from ehsvjax.effects.extended import effects_of, extended
from ehsvjax.effects.forces import FORCE, FRICTION, LOAD, STORAGE
from ehsvjax.effects.series import INPUT, SENSOR
from ehsvjax.effects.valve import DAMPING, DISPLACEMENT, DRIFT, VALVE

_MECHANICS = (*FORCE, *LOAD, *FRICTION, *STORAGE)
BANK: tuple[Effect, ...] = (*INPUT, *SENSOR, *_MECHANICS, *VALVE, *DAMPING, *DISPLACEMENT, *DRIFT)
"""Every effect of this package; `diagnose(..., bank=(*BANK, my_effect))` adds one of yours."""

__all__ = [
    "BANK",
    "Candidate",
    "Effect",
    "EffectParameter",
    "amplitude",
    "attach",
    "candidates",
    "effects_of",
    "extended",
    "limit",
    "shape",
    "size",
    "width",
]
