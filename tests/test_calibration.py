"""The benchmark of probabilities, on statements whose chance of being right is known."""

import numpy as np
import pytest

from benchmarks.calibration import reliability, statements, within_set


def rows_of(count, probability, seed):
    """Single effects that are named with some probability, and are there as often."""
    right = np.random.default_rng(seed).random(count) < probability
    return [
        {"verdict": "named", "names": ["a"], "probabilities": [{"a" if so else "b@place": probability}]} for so in right
    ]


@pytest.mark.parametrize("probability", [0.3, 0.7, 0.97])
def test_names_that_are_right_as_often_as_they_say_are_on_the_diagonal(probability):
    table = reliability(statements(rows_of(4000, probability, 1)))
    (row,) = table.itertuples(index=False)
    assert row[0] == 4000 and row[1] == pytest.approx(probability)
    assert abs(row[2] - row[1]) < 4.0 * row[3]


def test_names_that_are_too_sure_lie_below_it():
    rows = rows_of(2000, 0.5, 2)
    for row in rows:
        row["probabilities"] = [dict.fromkeys(row["probabilities"][0], 0.9)]
    (row,) = reliability(statements(rows)).itertuples(index=False)
    assert row[1] - row[2] > 10.0 * row[3]


def test_a_set_holds_what_is_most_probable_first_and_no_more_than_is_needed():
    group = {"a": 0.6, "b@x": 0.36, "c": 0.03, "d": 0.01}
    rows = [{"verdict": "ambiguous", "names": [name], "probabilities": [group]} for name in ("a", "b", "c", "d")]
    assert within_set(rows) == (2, 4)


def test_what_the_bank_lacks_and_what_failed_tell_nothing():
    rows = [
        {"verdict": "named", "names": ["unknown_bump"], "probabilities": [{"a": 0.9}]},
        {"verdict": "failed", "names": ["a"]},
        {"verdict": "adequate", "names": ["a"], "probabilities": []},
        {"verdict": "named", "name": "mass", "probabilities": [{"mass": 0.9}]},
    ]
    assert statements(rows)["right"].tolist() == [True]
    assert within_set(rows) == (1, 1)
