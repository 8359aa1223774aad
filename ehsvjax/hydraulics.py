"""Steady hydraulics of a spool valve: section 2 of the paper, equations (1) to (8).

Pure functions of scalars or of arrays that broadcast against each other, SI units, safe under `jit`, `grad`
and `vmap`. They may be traced, so that values are not checked; what is no number or does not broadcast is refused with
a ValueError.

Sources are the paper's equations and H. E. Merritt, Hydraulic Control Systems, Wiley 1967: chapter 3 for
orifices and continuity, chapter 5 for spool valves.
"""

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any, ParamSpec

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Real

from ehsvjax.checks import refused
from ehsvjax.structures import is_numeric

JET_ANGLE = math.radians(69.0)
"""Angle of the vena contracta to the spool axis, rad (paper, section 2.2)."""

DISCHARGE_COEFFICIENT = 0.61
"""Of a sharp-edged orifice, dimensionless (paper, section 2.2)."""

VELOCITY_COEFFICIENT = 0.98
"""Jet velocity over the ideal one, dimensionless (paper, section 2.2)."""

BULK_MODULUS = 1.5e9
"""Of mineral oil, Pa: the middle of the paper's 1400 to 1600 MPa (section 2.3)."""

Quantity = Real[ArrayLike, "*#batch"]
Result = Float[Array, "*batch"]

_Quantities = ParamSpec("_Quantities")


def _of_quantities(function: Callable[_Quantities, Result]) -> Callable[_Quantities, Result]:
    """Return the function with its arguments checked: real numbers or arrays of them, of shapes that broadcast."""
    names = tuple(inspect.signature(function).parameters)

    @functools.wraps(function)
    def checked(*args: _Quantities.args, **kwargs: _Quantities.kwargs) -> Result:
        """Raise a ValueError for what is no quantity, or call the function."""
        given: dict[str, Any] = {**dict(zip(names, args, strict=False)), **kwargs}
        for name, value in given.items():
            if not is_numeric(value) or jnp.iscomplexobj(value):
                raise refused(name, "a real number or an array of them", value, "give it in SI units")
        shapes = {name: np.shape(value) for name, value in given.items()}
        try:
            np.broadcast_shapes(*shapes.values())
        except ValueError:
            raise refused(
                "shapes", "such that they broadcast", shapes, "give arrays of one shape, or scalars"
            ) from None
        return function(*args, **kwargs)

    return checked


@_of_quantities
def orifice_flow(discharge_coefficient: Quantity, area: Quantity, density: Quantity, pressure_drop: Quantity) -> Result:
    """Turbulent flow through an orifice, m^3/s; a negative drop drives it backwards.

    Coefficient dimensionless, area in m^2, density in kg/m^3, drop P1 - P2 in Pa. Paper, equation (1). The
    printed form lost its root around the drop and has not the unit of a flow; meant is
    Q = Cd A0 sqrt(2/rho (P1 - P2)).
    """
    return signed_sqrt(2.0 / density * pressure_drop) * discharge_coefficient * area


@_of_quantities
def valve_flow_gain(discharge_coefficient: Quantity, area_gradient: Quantity, density: Quantity) -> Result:
    """Hydraulic constant H = Cd w / sqrt(rho) of a valve, m^2.5 kg^-0.5.

    Coefficient dimensionless, area gradient w = dA/dxv in m, density in kg/m^3. Paper, section 4. H is not
    the coefficient K_Q, which is a derivative of the flow and has the unit m^2/s.
    """
    return jnp.divide(discharge_coefficient * area_gradient, jnp.sqrt(density))


@_of_quantities
def load_flow(flow_gain: Quantity, spool: Quantity, supply_pressure: Quantity, load_pressure: Quantity) -> Result:
    """Flow to the load of an ideal critical-centre four-way valve, m^3/s.

    Flow gain H in m^2.5 kg^-0.5, spool xv in m, pressures in Pa. Paper, equations (2) and (4), with the root
    read as covering the pressures: Q = H xv sqrt(Ps - sgn(xv) PL). A load that pushes harder than the supply,
    sgn(xv) PL > Ps, drives the flow backwards (odd continuation of the root). At xv = 0 the slopes in xv from
    the right and the left, H sqrt(Ps - PL) and H sqrt(Ps + PL), differ; the derivative there is H sqrt(Ps).
    For the derivative at stall, sgn(xv) PL = Ps, see `signed_sqrt`.
    """
    return signed_sqrt(supply_pressure - jnp.sign(spool) * load_pressure) * flow_gain * spool


@_of_quantities
def flow_gain_coefficient(
    flow_gain: Quantity, spool: Quantity, supply_pressure: Quantity, load_pressure: Quantity
) -> Result:
    """K_Q = dQ/dxv of `load_flow` at an operating point, m^2/s; same arguments. Paper, equation (3)."""
    return _load_flow_derivative(1, flow_gain, spool, supply_pressure, load_pressure)


@_of_quantities
def flow_pressure_coefficient(
    flow_gain: Quantity, spool: Quantity, supply_pressure: Quantity, load_pressure: Quantity
) -> Result:
    """K_C = -dQ/dPL of `load_flow` at an operating point, m^3/(s Pa); same arguments. Paper, equation (3).

    Never negative. It grows without bound towards stall, sgn(xv) PL = Ps, and is returned as 0 exactly there.
    """
    return -_load_flow_derivative(3, flow_gain, spool, supply_pressure, load_pressure)


@_of_quantities
def linearised_load_flow(
    flow_gain: Quantity,
    spool: Quantity,
    supply_pressure: Quantity,
    load_pressure: Quantity,
    spool_deviation: Quantity,
    load_pressure_deviation: Quantity,
) -> Result:
    """Change of the load flow, m^3/s, for small deviations from an operating point.

    The first four arguments are the point, as for `load_flow`; deviations in m and in Pa. Paper, equation
    (3), which prints + K_C PL beside K_C = -dQ/dPL, a slip of the sign: Taylor's series gives
    K_Q dxv - K_C dPL (Merritt, chapter 5).
    """
    point = (flow_gain, spool, supply_pressure, load_pressure)
    return flow_gain_coefficient(*point) * spool_deviation - flow_pressure_coefficient(*point) * load_pressure_deviation


def normalised_pressure_flow_curves(
    spool_fractions: Real[ArrayLike, " curve"], pressure_fractions: Real[ArrayLike, " point"]
) -> Float[Array, "curve point"]:
    """Figure 1 of the paper: Q/Qmax, with Qmax = H xv_max sqrt(Ps), one curve for each spool opening.

    Spool fractions xv/xv_max, pressure fractions PL/Ps; all dimensionless. ValueError for what is no row of numbers.
    """
    for name, row in (("spool_fractions", spool_fractions), ("pressure_fractions", pressure_fractions)):
        numbers = np.asarray(row) if isinstance(row, list | tuple) else row
        if not is_numeric(numbers) or np.ndim(numbers) != 1 or jnp.iscomplexobj(numbers):
            raise refused(name, "a row of real numbers", row, "give one number for each curve or point")
    spool, load_pressure = jnp.asarray(spool_fractions), jnp.asarray(pressure_fractions)
    return load_flow(1.0, spool[:, None], 1.0, load_pressure[None, :])


@_of_quantities
def steady_flow_force(
    discharge_coefficient: Quantity,
    velocity_coefficient: Quantity,
    area: Quantity,
    pressure_drop: Quantity,
    jet_angle: Quantity,
) -> Result:
    """Steady flow force of one orifice, N, positive when it pushes the spool shut.

    Coefficients dimensionless, area in m^2, drop in Pa, angle of the jet to the spool axis in rad. Paper,
    equation (5): F1 = 2 Cd Cv A0 (P1 - P2) cos(theta).
    """
    return 2.0 * jnp.cos(jet_angle) * discharge_coefficient * velocity_coefficient * area * pressure_drop


@_of_quantities
def flow_force_stiffness(area_gradient: Quantity, pressure_drop: Quantity) -> Result:
    """Stiffness K_f of the steady flow force of one orifice, F1 = K_f xv, N/m, with the paper's coefficients.

    Area gradient w in m, drop in Pa. Paper, equation (6): 2 Cd Cv cos(theta) = 0.4285, printed as 0.43. A
    four-way valve has two such orifices in series with the drop (Ps - sgn(xv) PL)/2 across each, so the whole
    spool feels this stiffness at the drop Ps - sgn(xv) PL (Merritt, chapter 5).
    """
    return steady_flow_force(DISCHARGE_COEFFICIENT, VELOCITY_COEFFICIENT, area_gradient, pressure_drop, JET_ANGLE)


@_of_quantities
def continuity_flow(volume: Quantity, volume_rate: Quantity, pressure_rate: Quantity, bulk_modulus: Quantity) -> Result:
    """Net flow into a chamber of variable volume, m^3/s: sum Q = dV/dt + (V/beta) dP/dt.

    Volume in m^3, its rate in m^3/s, rate of pressure in Pa/s, bulk modulus in Pa. This is the textbook form
    (Merritt, chapter 3), with the flows counted at the density in the chamber. The paper's equation (7) is
    d/dt (V + V P/beta), which has one term more, (P/beta) dV/dt, since it counts the flows at the density of
    oil without pressure. The term is 0.9% of dV/dt at P = 140 bar and beta = 1500 MPa; it vanishes when the
    volume is constant.
    """
    return constant_chamber_flow(volume, pressure_rate, bulk_modulus) + volume_rate


@_of_quantities
def constant_chamber_flow(volume: Quantity, pressure_rate: Quantity, bulk_modulus: Quantity) -> Result:
    """Net flow into a chamber of constant volume, m^3/s: sum Q = C_H dP/dt. Paper, equation (8).

    Volume in m^3, rate of pressure in Pa/s, bulk modulus in Pa.
    """
    return hydraulic_capacitance(volume, bulk_modulus) * pressure_rate


@_of_quantities
def hydraulic_capacitance(volume: Quantity, bulk_modulus: Quantity) -> Result:
    """Hydraulic capacitance C_H = V/beta of a chamber, m^3/Pa. Paper, section 2.3, below equation (8).

    Volume in m^3, bulk modulus in Pa.
    """
    return jnp.divide(volume, bulk_modulus)


@_of_quantities
def signed_sqrt(pressure: Quantity) -> Result:
    """Odd continuation of the square root, sgn(p) sqrt|p|.

    Its derivative 1/(2 sqrt|p|) has no finite limit at p = 0 and is defined there as 0, so that gradients
    through a valve that is stalled or has no drop stay finite.
    """
    nonzero = jnp.not_equal(pressure, 0)
    # The root must not be evaluated at 0 even where it is not selected: inf * 0 in its derivative is NaN.
    magnitude = jnp.where(nonzero, jnp.abs(pressure), 1.0)
    return jnp.where(nonzero, jnp.sign(pressure) * jnp.sqrt(magnitude), 0.0)


def _load_flow_derivative(argument: int, *operands: Quantity) -> Result:
    derivative = jnp.vectorize(jax.grad(load_flow, argnums=argument))
    return derivative(*(1.0 * jnp.asarray(operand) for operand in operands))
