"""Numbers with their units, as they are read."""

import math

import pytest

from ehsvjax.quantities import quantity


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (5.945e-5, "m", "59.5 µm"),
        (-1.9996e-3, "m", "-2 mm"),
        (9.996e-4, "m", "1 mm"),
        (0.0, "Pa", "0 Pa"),
        (1.4e7, "Pa", "14 MPa"),
        (5948.0, "N", "5.95 kN"),
        (3e-13, "m", "0.0003 nm"),
        (4.7e-12, "m^3/(s Pa)", "4.7e-12 m^3/(s Pa)"),
        (0.0475, "s", "47.5 ms"),
        (2000.0, "s", "2000 s"),
        (0.31, "", "0.31"),
        (math.nan, "m", "not finite"),
        (math.inf, "", "not finite"),
    ],
)
def test_a_value_is_written_in_the_prefix_that_reads_best(value, unit, words):
    assert quantity(value, unit) == words


def test_an_error_has_the_prefix_of_its_value():
    assert quantity(5.945e-5, "m", 1.8e-6) == "59.5 +/- 1.8 µm"
    assert quantity(5948.0, "N", 18.0, digits=4) == "5.948 +/- 0.018 kN"
    assert quantity(2341.0, "1/s", 230.0) == "2340 +/- 230 1/s"
    assert quantity(0.31, "", 0.02) == "0.31 +/- 0.02"
    assert quantity(1.0, "m", math.inf) == quantity(1.0, "m", math.nan) == "1 m"
