"""Section 2 of the paper against hand calculations, symmetries and limits."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehsvjax import hydraulics as hy

SUPPLY = 14e6  # Pa, the paper's 140 bar


def _assert_close(actual, expected, relative):
    # pytest.approx adds an absolute 1e-12, the size of a hydraulic capacitance.
    np.testing.assert_allclose(actual, expected, rtol=relative, atol=0.0)


@pytest.fixture(params=[False, True], ids=["float32", "float64"])
def tolerance(request):
    with jax.enable_x64(request.param):
        yield 1e-12 if request.param else 1e-6


# --- Orifice (1) ---


def test_orifice_flow_by_hand(tolerance):
    # 2/800 * 4e6 = 1e4 (m/s)^2, so the jet does 100 m/s; 0.6 * 1e-5 m^2 * 100 m/s = 6e-4 m^3/s (36 L/min).
    _assert_close(hy.orifice_flow(0.6, 1e-5, 800.0, 4e6), 6e-4, tolerance)
    _assert_close(hy.orifice_flow(0.6, 1e-5, 800.0, -4e6), -6e-4, tolerance)
    assert hy.orifice_flow(0.6, 1e-5, 800.0, 0.0) == 0.0


def test_signed_sqrt_by_hand(tolerance):
    roots = hy.signed_sqrt(jnp.asarray([-9.0, -0.25, 0.0, 4.0, 1.44e8]))
    _assert_close(roots, [-3.0, -0.5, 0.0, 2.0, 1.2e4], tolerance)


def test_signed_sqrt_derivative_by_hand(tolerance):
    # 1/(2 sqrt|p|) on both sides, and by definition 0 at 0.
    slopes = [jax.grad(hy.signed_sqrt)(p) for p in (-9.0, 0.0, 4.0)]
    _assert_close(slopes, [1 / 6, 0.0, 1 / 4], tolerance)


def test_signed_sqrt_keeps_nan():
    assert np.isnan(hy.signed_sqrt(math.nan))


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd, lambda f: jax.grad(jax.grad(f))])
@pytest.mark.parametrize("pressure", [0.0, -0.0, 1e-20, -1e-20])
def test_signed_sqrt_derivatives_are_finite_at_and_near_zero(derivative, pressure):
    assert np.isfinite(derivative(hy.signed_sqrt)(pressure))


@settings(max_examples=30, deadline=None)
@given(st.floats(-1e9, 1e9))
def test_signed_sqrt_is_the_inverse_of_the_signed_square(pressure):
    with jax.enable_x64(True):
        root = float(hy.signed_sqrt(pressure))
    assert root * abs(root) == pytest.approx(pressure, rel=1e-14, abs=1e-300)


# --- Load flow (2), (4) and its coefficients (3) ---


def test_valve_flow_gain_by_hand(tolerance):
    # 0.6 * 0.01 m / sqrt(900 kg/m^3) = 0.006/30 = 2e-4.
    _assert_close(hy.valve_flow_gain(0.6, 0.01, 900.0), 2e-4, tolerance)


@pytest.mark.parametrize(
    ("spool", "load_pressure", "expected"),
    [
        (1e-3, 5e6, 6e-4),  # 2e-4 * 1e-3 * sqrt(14e6 - 5e6) = 2e-7 * 3000
        (-1e-3, 2e6, -8e-4),  # sqrt(14e6 + 2e6) = 4000
        (1e-3, 18e6, -4e-4),  # the load overruns the supply: -sqrt(18e6 - 14e6) = -2000
        (-1e-3, -18e6, 4e-4),
        (1e-3, SUPPLY, 0.0),  # stall
        (-1e-3, -SUPPLY, 0.0),
        (0.0, 5e6, 0.0),  # closed
    ],
)
def test_load_flow_by_hand(spool, load_pressure, expected, tolerance):
    _assert_close(hy.load_flow(2e-4, spool, SUPPLY, load_pressure), expected, tolerance)


def test_load_flow_is_the_flow_through_two_equal_orifices_in_series(tolerance):
    # Each of the two open edges of a critical-centre valve has the area w xv and takes half of Ps - PL.
    coefficient, gradient, density, spool, load_pressure = 0.61, 7e-3, 850.0, 2e-3, 3e6
    edge = hy.orifice_flow(coefficient, gradient * spool, density, (SUPPLY - load_pressure) / 2)
    gain = hy.valve_flow_gain(coefficient, gradient, density)
    _assert_close(hy.load_flow(gain, spool, SUPPLY, load_pressure), float(edge), 5 * tolerance)


@pytest.mark.parametrize(
    ("spool", "load_pressure", "flow_gain_coefficient", "flow_pressure_coefficient"),
    [
        # root 3000: K_Q = 2e-4 * 3000 = 0.6 m^2/s, K_C = 2e-4 * 1e-3/(2 * 3000) = 1e-10/3 m^3/(s Pa)
        (1e-3, 5e6, 0.6, 1e-10 / 3),
        # root 4000: K_Q = 0.8 m^2/s, K_C = 2e-7/8000 m^3/(s Pa)
        (-1e-3, 2e6, 0.8, 2.5e-11),
        # closed, root 4000 to the left and sqrt(12e6) to the right: in between, 2e-4 * sqrt(14e6)
        (0.0, 2e6, 2e-4 * math.sqrt(14e6), 0.0),
    ],
)
def test_coefficients_by_hand(spool, load_pressure, flow_gain_coefficient, flow_pressure_coefficient, tolerance):
    point = (2e-4, spool, SUPPLY, load_pressure)
    _assert_close(hy.flow_gain_coefficient(*point), flow_gain_coefficient, tolerance)
    _assert_close(hy.flow_pressure_coefficient(*point), flow_pressure_coefficient, tolerance)


def test_coefficients_at_stall(tolerance):
    # The root is 0: so is K_Q, and K_C, which has no finite value, is returned as 0.
    assert hy.flow_gain_coefficient(2e-4, 1e-3, SUPPLY, SUPPLY) == 0.0
    assert hy.flow_pressure_coefficient(2e-4, 1e-3, SUPPLY, SUPPLY) == 0.0


def test_coefficients_take_integers():
    assert hy.flow_gain_coefficient(2, 0, 9, 0) == pytest.approx(6.0)


def _flow_by_numpy(spool, load_pressure):
    drop = SUPPLY - np.sign(spool) * load_pressure
    return 1.45e-4 * spool * np.sign(drop) * np.sqrt(np.abs(drop))


@pytest.mark.parametrize("spool", [-3e-3, -1e-4, 2e-4, 3e-3])
@pytest.mark.parametrize("load_pressure", [-17e6, -9e6, 0.0, 4e6, 16e6])
def test_coefficients_against_central_differences(spool, load_pressure):
    step, pressure_step = 1e-8, 10.0
    by_spool = _flow_by_numpy(spool + step, load_pressure) - _flow_by_numpy(spool - step, load_pressure)
    by_pressure = _flow_by_numpy(spool, load_pressure + pressure_step) - _flow_by_numpy(
        spool, load_pressure - pressure_step
    )
    with jax.enable_x64(True):
        point = (1.45e-4, spool, SUPPLY, load_pressure)
        flow_gain_coefficient = float(hy.flow_gain_coefficient(*point))
        flow_pressure_coefficient = float(hy.flow_pressure_coefficient(*point))
    _assert_close(flow_gain_coefficient, by_spool / (2 * step), 1e-6)
    _assert_close(flow_pressure_coefficient, -by_pressure / (2 * pressure_step), 1e-6)


def test_gradients_are_finite_where_the_flow_has_kinks(tolerance):
    derivatives = jax.jit(jax.jacrev(hy.load_flow, argnums=(0, 1, 2, 3)))
    forward = jax.jit(jax.jacfwd(hy.load_flow, argnums=(0, 1, 2, 3)))
    for spool, load_pressure in itertools.product((-1e-3, 0.0, 1e-3), (-SUPPLY, 0.0, SUPPLY)):
        point = (2e-4, spool, SUPPLY, load_pressure)
        assert np.isfinite(derivatives(*point)).all(), point
        assert np.isfinite(forward(*point)).all(), point
    assert np.isfinite(derivatives(2e-4, 0.0, 0.0, 0.0)).all()


def test_linearised_load_flow_by_hand(tolerance):
    # K_Q = 0.6, K_C = 1e-10/3 as above: 0.6 * 1e-5 - 1e-10/3 * 3e4 = 6e-6 - 1e-6 = 5e-6 m^3/s. With the
    # printed sign it would be 7e-6.
    change = hy.linearised_load_flow(2e-4, 1e-3, SUPPLY, 5e6, 1e-5, 3e4)
    _assert_close(change, 5e-6, 10 * tolerance)


def test_linearised_load_flow_is_wrong_to_second_order_only():
    def error(scale):
        exact = _flow_by_numpy(1e-3 + 1e-4 * scale, 5e6 + 1e6 * scale) - _flow_by_numpy(1e-3, 5e6)
        return exact - float(hy.linearised_load_flow(1.45e-4, 1e-3, SUPPLY, 5e6, 1e-4 * scale, 1e6 * scale))

    with jax.enable_x64(True):
        _assert_close(error(0.01) / error(0.005), 4.0, 0.01)


spools = st.floats(-5e-3, 5e-3)
pressures = st.floats(-2 * SUPPLY, 2 * SUPPLY)


@settings(max_examples=30, deadline=None)
@given(spools, pressures)
def test_load_flow_is_odd_in_spool_and_load_pressure_together(spool, load_pressure):
    with jax.enable_x64(True):
        flow = float(hy.load_flow(1.45e-4, spool, SUPPLY, load_pressure))
        assert float(hy.load_flow(1.45e-4, -spool, SUPPLY, -load_pressure)) == -flow


@settings(max_examples=30, deadline=None)
@given(spools, pressures, pressures)
def test_load_flow_never_rises_with_load_pressure(spool, one, other):
    with jax.enable_x64(True):
        low = float(hy.load_flow(1.45e-4, spool, SUPPLY, min(one, other)))
        assert float(hy.load_flow(1.45e-4, spool, SUPPLY, max(one, other))) <= low


@settings(max_examples=30, deadline=None)
@given(spools, spools, st.floats(-SUPPLY, SUPPLY))
def test_load_flow_never_falls_with_spool_below_the_supply_pressure(one, other, load_pressure):
    with jax.enable_x64(True):
        low = float(hy.load_flow(1.45e-4, min(one, other), SUPPLY, load_pressure))
        assert float(hy.load_flow(1.45e-4, max(one, other), SUPPLY, load_pressure)) >= low


@settings(max_examples=30, deadline=None)
@given(st.floats(1e-5, 5e-3), st.floats(-0.99 * SUPPLY, 0.99 * SUPPLY))
def test_ratio_of_the_coefficients_is_merritts_pressure_sensitivity(spool, load_pressure):
    # K_Q/K_C = 2 (Ps - PL)/xv for xv > 0.
    with jax.enable_x64(True):
        point = (1.45e-4, spool, SUPPLY, load_pressure)
        ratio = float(hy.flow_gain_coefficient(*point) / hy.flow_pressure_coefficient(*point))
    _assert_close(ratio, 2 * (SUPPLY - load_pressure) / spool, 1e-9)


def test_arrays_broadcast_and_trace():
    spool = jnp.linspace(-1e-3, 1e-3, 3)[:, None]
    load_pressure = jnp.linspace(-1e7, 1e7, 4)[None, :]
    for function in (hy.load_flow, hy.flow_gain_coefficient, hy.flow_pressure_coefficient):
        table = jax.jit(function)(2e-4, spool, SUPPLY, load_pressure)
        assert table.shape == (3, 4)
        corner = function(2e-4, float(spool[0, 0]), SUPPLY, float(load_pressure[0, 3]))
        _assert_close(table[0, 3], float(corner), 1e-5)


def test_normalised_curves_by_hand(tolerance):
    curves = hy.normalised_pressure_flow_curves(np.asarray([1.0, 0.5, -1.0]), np.asarray([0.0, 0.75, 1.0, -0.44]))
    expected = [
        [1.0, 0.5, 0.0, 1.2],  # sqrt(1), sqrt(0.25), stall, sqrt(1.44)
        [0.5, 0.25, 0.0, 0.6],  # half of it
        [-1.0, -math.sqrt(1.75), -math.sqrt(2.0), -math.sqrt(0.56)],  # -sqrt(1 + PL/Ps)
    ]
    _assert_close(curves, expected, tolerance)


# --- Flow forces (5), (6) ---


def test_steady_flow_force_by_hand(tolerance):
    # 2 * 0.5 * 1 * 2e-5 m^2 * 1e7 Pa * cos 60 deg = 100 N.
    force = hy.steady_flow_force(0.5, 1.0, 2e-5, 1e7, math.pi / 3)
    _assert_close(force, 100.0, tolerance)


def test_flow_force_stiffness_rounds_to_the_papers_coefficient():
    # 2 * 0.61 * 0.98 = 1.1956, cos 69 deg = 0.35837, product 0.42847.
    coefficient = float(hy.flow_force_stiffness(1.0, 1.0))
    assert coefficient == pytest.approx(0.42847, abs=1e-5)
    assert round(coefficient, 2) == 0.43


def test_flow_force_of_merritts_large_valve():
    # Spool of 1 in, so w = pi * 25.4 mm = 79.796 mm; 1000 psi = 6.8948 MPa; stroke 0.020 in = 0.508 mm:
    # 0.42847 * 0.079796 * 6.8948e6 = 2.3573e5 N/m, times 0.508e-3 = 119.75 N = 26.9 lb. The paper says that
    # it can exceed 20 lb.
    force = float(hy.flow_force_stiffness(0.079796, 6.8948e6)) * 0.508e-3
    _assert_close(force, 119.75, 1e-4)
    assert force / 4.4482 > 20


# --- Continuity (7), (8) ---


def test_continuity_by_hand(tolerance):
    # C_H = 1.5e-3 m^3/1.5e9 Pa = 1e-12 m^3/Pa, which takes 1e-3 m^3/s at 1e9 Pa/s; with the volume growing
    # by 2e-3 m^3/s that makes 3e-3 m^3/s.
    _assert_close(hy.hydraulic_capacitance(1.5e-3, 1.5e9), 1e-12, tolerance)
    _assert_close(hy.constant_chamber_flow(1.5e-3, 1e9, 1.5e9), 1e-3, tolerance)
    _assert_close(hy.continuity_flow(1.5e-3, 2e-3, 1e9, 1.5e9), 3e-3, tolerance)
    _assert_close(hy.continuity_flow(1.5e-3, 0.0, 1e9, 1.5e9), 1e-3, tolerance)


VOLUME, VOLUME_RATE, PRESSURE_RATE = 1e-3, 2e-3, 5e8


def _rate(quantity):
    """Central difference at time 0 of a function of the chamber's volume and pressure."""
    step = 1e-5
    ahead, behind = (quantity(VOLUME + VOLUME_RATE * t, SUPPLY + PRESSURE_RATE * t) for t in (step, -step))
    return (ahead - behind) / (2 * step)


def test_continuity_conserves_mass():
    # Mass rho V with rho = rho0 exp(P/beta), which is what a constant bulk modulus means, fed at density rho.
    mass_rate = _rate(lambda volume, pressure: 850 * math.exp(pressure / hy.BULK_MODULUS) * volume)
    density = 850 * math.exp(SUPPLY / hy.BULK_MODULUS)
    with jax.enable_x64(True):
        flow = float(hy.continuity_flow(VOLUME, VOLUME_RATE, PRESSURE_RATE, hy.BULK_MODULUS))
    _assert_close(flow, mass_rate / density, 1e-8)


def test_equation_7_as_printed_has_one_term_more():
    printed = _rate(lambda volume, pressure: volume + volume * pressure / hy.BULK_MODULUS)
    with jax.enable_x64(True):
        flow = float(hy.continuity_flow(VOLUME, VOLUME_RATE, PRESSURE_RATE, hy.BULK_MODULUS))
    # 14 MPa/1500 MPa = 0.93% of the volume's rate.
    _assert_close((printed - flow) / VOLUME_RATE, 0.0093333, 1e-4)
