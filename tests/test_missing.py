"""Missing terms, from numbers alone: what is the unknowns', steps that do not wander, the least of equal terms."""

from functools import partial

import numpy as np
import pytest

from ehsvjax.diagnosis.bench.refits import span
from ehsvjax.diagnosis.hypotheses.curves import Curve, hats
from ehsvjax.diagnosis.hypotheses.missing import _damped_steps, _free, _least, _outside

TIME = np.linspace(0.0, 1.0, 800)
ALONG = np.sin(9.0 * TIME)
KNOTS = np.linspace(-1.0, 1.0, 9)
HATS = np.stack([np.interp(ALONG, KNOTS, value) for value in np.eye(len(KNOTS))])
CURVE = Curve("force", "position", KNOTS, np.eye(len(KNOTS)), ALONG[None], partial(hats, KNOTS), False, np.zeros(0))
# Unknowns that can do a constant, and something that no curve along the quantity does.
UNKNOWNS = np.stack([np.full(len(TIME), 3.0), np.cos(70.0 * TIME)])


def test_what_the_unknowns_can_do_is_not_a_curves():
    known = span(UNKNOWNS)
    outside = _outside(HATS, known)
    assert np.max(np.abs(outside @ known)) < 1e-12
    # A constant, the sum of all hats, is gone; a straight line is what it was but for its mean.
    assert np.max(np.abs(outside.sum(axis=0))) < 1e-12
    line = KNOTS @ HATS
    assert KNOTS @ outside == pytest.approx(line - known @ (known.T @ line), abs=1e-9)


def test_what_hardly_reaches_beyond_the_unknowns_is_theirs():
    nearly = np.vstack([UNKNOWNS, ALONG + 1e-3 * np.cos(40.0 * TIME)])
    values = np.linalg.svd(_outside(HATS, span(nearly)), compute_uv=False)
    # Of nine pieces the constant is gone, and what is nearly the straight line.
    assert np.sum(values > 1e-6) == 7 and values[6] > 0.1
    assert np.sum(np.linalg.svd(_outside(HATS, span(UNKNOWNS)), compute_uv=False) > 1e-6) == 8


@pytest.mark.parametrize("offset", [0.0, 5.0, -200.0])
def test_a_curve_does_not_take_what_the_unknowns_lack(offset):
    truth = np.exp(-8.0 * (KNOTS - 0.4) ** 2)
    r = truth @ HATS + offset * UNKNOWNS[0]
    of_unknowns, of_pieces = _damped_steps(UNKNOWNS, HATS, r)[0]
    assert of_unknowns @ UNKNOWNS + of_pieces @ HATS == pytest.approx(r, abs=1e-6)
    # The same curve for every offset, which only the unknowns have to make up for.
    assert of_pieces == pytest.approx(_damped_steps(UNKNOWNS, HATS, truth @ HATS)[0][1], abs=1e-6)


def test_the_lines_that_the_unknowns_make_up_for_are_free():
    free = _free(CURVE, HATS, span(UNKNOWNS))
    assert len(free) == 1 and np.ptp(free[0]) < 1e-9
    both = _free(CURVE, HATS, span(np.vstack([UNKNOWNS, ALONG])))
    assert len(both) == 2 and np.linalg.matrix_rank(np.vstack([both, np.ones(9), KNOTS]), tol=1e-6) == 2
    wave = CURVE._replace(values=np.ones((2, 9)), periods=np.array([0.3]))
    assert _free(wave, HATS[:2], span(UNKNOWNS)).shape == (0, 2)


def test_of_equal_terms_the_one_that_acts_least_is_told():
    bump = -np.exp(-0.5 * ((ALONG - 0.4) / 0.1) ** 2)
    free = np.stack([np.ones(len(TIME)), ALONG])
    assert _least(bump + np.array([0.3, -0.7]) @ free, free) == pytest.approx([-0.3, 0.7], abs=0.01)
    assert _least(bump, free[:0]).shape == (0,)
