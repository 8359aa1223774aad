"""Effects that a user wrote are refused by name, before anything is searched, if they cannot be meant."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ehsvjax
from ehsvjax import Effect
from ehsvjax.diagnosis import diagnose, recipe
from ehsvjax.effects import amplitude
from ehsvjax.effects.effect import EffectParameter, constant
from tests.plants import held_levels
from tests.small_models import carriage, carriage_plant, record_of

KEY = jax.random.key(0)
PERIOD, SAMPLES = 0.02, 300


@pytest.fixture(scope="module")
def record():
    push = held_levels(5, 20.0, SAMPLES // 20, 20)
    return record_of(PERIOD, {"push": push}, {"position": carriage_plant(push, PERIOD)[:, 0]}, {"position": 2e-3}, 1)


@pytest.fixture(scope="module")
def fit(record):
    return ehsvjax.identify(carriage(), record, key=KEY, population=40, generations=15)


@pytest.fixture
def unsearched(monkeypatch):
    """No search is begun."""

    def search(bench, progress):
        raise AssertionError("searched")

    monkeypatch.setattr(recipe, "select", search)


def depth(tries=(0.1,), absent=0.0):
    tried = list(tries)
    return EffectParameter("depth", "{value}", absent, constant(-10.0), constant(10.0), lambda scales: tried)


def groove(apply, kind="force", number=None, needs=("position",), memory=()):
    return Effect("groove", kind, (depth() if number is None else number,), apply, needs=needs, memory=memory)


def rooted(own, force, context):
    """Return NaN where the position is negative."""
    return force - own["depth"] * jnp.sqrt(context["position"])


def inert(own, force, context):
    """Forget what was computed."""
    del own, context
    return force


def always(own, force, context):
    """Act without a depth too."""
    return force - (own["depth"] + 1.0) * context["position"]


def cubed(own, force, context):
    """What is meant."""
    return force - own["depth"] * context["position"] ** 3


def shallow(own, force, context):
    """Return NaN for any depth but none."""
    return force - own["depth"] * context["position"] - jnp.sqrt(-own["depth"])


def counting(own, force, context, memory):
    """Remember, and be there when absent."""
    del context
    return force + own["depth"] * memory[0] + 1.0, (memory[0] + 1.0,)


def doubled(own, series, context):
    """Change an input by nothing."""
    del own, context
    return series


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (groove(rooted), r"finite values of force from groove, got nan at depth = 0: mind divisions"),
        (groove(shallow), r"finite values of force from groove, got nan at depth = 0\.1: mind divisions"),
        (groove(inert), "groove to change force at some value that it says to try, got no change at any"),
        (groove(always), "groove to leave force as it is at depth = 0, where it is said to be absent; it is changed"),
        (groove(counting, needs=(), memory=(0.0,)), "groove to leave force as it is at depth = 0, where it is said to"),
        (groove(cubed, number=depth(tries=())), "groove to name values of depth to try, got none"),
        (groove(cubed, number=depth(tries=(0.0,))), "groove to change force at some value that it says to try"),
        (groove(doubled, kind="input", needs=()), "groove to change push at some value that it says to try"),
        (groove(cubed, kind="groove"), "signal of kind groove that comes with position for groove; carriage has push"),
        (groove(cubed, needs=("temperature",)), "signal of kind force that comes with temperature for groove"),
    ],
    ids=["nan", "nan at a try", "inert", "always", "with memory", "no tries", "zero", "input", "kind", "needs"],
)
def test_an_effect_that_cannot_be_meant_is_refused_by_name(unsearched, fit, record, effect, said):
    with pytest.raises(ValueError, match=said):
        diagnose(fit, record, key=KEY, bank=(effect,))


def test_an_effect_that_is_meant_is_searched(unsearched, fit, record):
    with pytest.raises(AssertionError, match="searched"):
        diagnose(fit, record, key=KEY, bank=(groove(cubed),))


def test_an_effect_that_a_fit_has_already_is_no_candidate_and_not_refused(unsearched, fit, record):
    effect = groove(cubed)
    bounds = {"groove.depth": (-1.0, 1.0)}
    model = ehsvjax.effects.attach(carriage(), bounds, duration=PERIOD * SAMPLES, bank=(effect,))
    extended = dataclasses.replace(fit, model=model, parameters=fit.parameters | {"groove.depth": 0.0})
    with pytest.raises(AssertionError, match="searched"):
        diagnose(extended, record, key=KEY, bank=(effect,))


def test_no_two_forms_share_a_name_and_a_number(unsearched, fit, record):
    twice = (groove(cubed), groove(rooted))
    with pytest.raises(ValueError, match="every effect of the bank once, got groove twice"):
        diagnose(fit, record, key=KEY, bank=twice)


def test_amplitudes_are_tried_as_they_are_given(fit, record):
    # A probe of the user's own may be of NumPy's type.
    number = amplitude("depth", "N", lambda scales: np.float64(1e-3))
    assert number.tries({"value": 1.0}) == (1e-3,)
