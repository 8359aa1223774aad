"""Independent plants that make test data: SciPy's integrators on the equations as the paper writes them.

Nothing of the package is used here. The stiff orifice equation is kept implicit (the pressure that the flow needs),
which divides by the spool's opening: a floor under the opening keeps it finite, and its size is shown not to matter.
"""

import itertools
import math
import warnings
from typing import NamedTuple

import numpy as np
from scipy.integrate import ODEintWarning, odeint, solve_ivp


class Motion(NamedTuple):
    """At the sample times: position m, velocity m/s, spool before dead zone m, load pressure Pa, each [time].

    Where the command jumps, the spool is that after the jump and the load pressure that before it.
    """

    position: np.ndarray
    velocity: np.ndarray
    spool: np.ndarray
    load_pressure: np.ndarray


class Valve(NamedTuple):
    """The paper's servovalve, SI units; a capacitance of 0 means that the flow is A*v + Ct*PL."""

    dead_zone: float = 1e-4
    saturation: float = 3e-3
    flow_gain: float = 1.45e-4
    feedback_gain: float = 0.09
    damping_ratio: float = 0.72
    natural_frequency: float = 300.0
    piston_area: float = 25e-4
    supply_pressure: float = 140e5
    mass: float = 20.0
    stiffness: float = 1e4
    hydraulic_capacitance: float = 0.0
    leakage_coefficient: float = 0.0
    flow_force: bool = False
    spool_stiffness: float = 1e6
    oil_density: float = 850.0
    transfer_function: str = "valve"
    open_loop: bool = False
    initial_position: float = 0.0
    initial_filtered: float = 0.0
    initial_filtered_rate: float = 0.0


def held_levels(seed, amplitude, count, samples) -> np.ndarray:
    """The paper's pseudo random signal: `count` levels, uniform in +-amplitude, each held for `samples` samples."""
    return np.repeat(np.random.default_rng(seed).uniform(-amplitude, amplitude, count), samples)


def servovalve_plant(command, sample_period, *, hold="zero", method="LSODA", rtol=1e-9, floor=1e-8, **valve) -> Motion:
    """Simulate the servovalve over a command [time], m; keywords as in `Valve`.

    Each piece of the command that is a straight line is integrated apart, so that no step is smeared over a jump.
    LSODA takes 0.1 s for the paper's record of 4 s, Radau 5 s.
    """
    valve = Valve(**valve)
    command = np.asarray(command, dtype=float)
    state = _initial_state(valve, command[0])
    absolute = [1e-11, 1e-9, 1e-12, 1e-9, 1.0][: len(state)]
    states, pressures = [state], [valve.stiffness * valve.initial_position / valve.piston_area]
    for first, last, start, slope in _straight_pieces(command, sample_period, hold):
        derivative, load_pressure = _equations(valve, floor, start, slope)
        times = np.arange(last - first + 1) * sample_period
        piece = _integrated(derivative, state, times, method, rtol, absolute)
        state = piece[-1]
        states.extend(piece[1:])
        pressures.extend(load_pressure(t, y) for t, y in zip(times[1:].tolist(), piece[1:].tolist(), strict=True))
    position, velocity, filtered = np.array(states)[: len(command), :3].T
    spool = command - filtered if valve.transfer_function == "return" else filtered
    return Motion(position, velocity, spool, np.array(pressures)[: len(command)])


def two_chamber_plant(command, sample_period, ratio, *, bulk=14e8, volume=5e-5, friction=0.0):
    """Simulate the paper's valve at a cylinder with one rod over a command [time]: position m, pA - pB Pa, each [time].

    Each chamber has its own oil, of a volume that the piston changes, and its own two orifices; the load has viscous
    friction. For equal areas H of the paper is that of two orifices in series: each has sqrt(2) of it.
    """
    v = Valve()
    area, other, orifice = v.piston_area, ratio * v.piston_area, math.sqrt(2.0) * v.flow_gain

    def through(opening, drop):
        return orifice * opening * math.copysign(math.sqrt(abs(drop)), drop)

    def equations(u):
        def derivative(t, y):
            x, speed, p, rate, ahead, behind = y
            opening = p - min(max(p, -v.dead_zone), v.dead_zone)
            opening = min(max(opening, -v.saturation), v.saturation)
            filled = through(opening, v.supply_pressure - ahead if opening > 0.0 else ahead)
            emptied = through(opening, behind if opening > 0.0 else v.supply_pressure - behind)
            driven = v.natural_frequency**2 * (u - v.feedback_gain * x - p)
            return [
                speed,
                (area * ahead - other * behind - v.stiffness * x - friction * speed) / v.mass,
                rate,
                driven - 2.0 * v.damping_ratio * v.natural_frequency * rate,
                bulk / (volume + area * (0.2 + x)) * (filled - area * speed),
                bulk / (volume + other * (0.2 - x)) * (other * speed - emptied),
            ]

        return derivative

    # At rest, as the valve leaves them that has just closed from forward.
    behind = v.supply_pressure * ratio**2 / (1.0 + ratio**3)
    state = np.array([0.0, 0.0, 0.0, 0.0, ratio * behind, behind])
    states = [state]
    for first, last, u, _ in _straight_pieces(np.asarray(command, dtype=float), sample_period, "zero"):
        times = np.arange(last - first + 1) * sample_period
        piece = _integrated(equations(u), state, times, "LSODA", 1e-8, [1e-9, 1e-7, 1e-10, 1e-7, 1.0, 1.0])
        state = piece[-1]
        states.extend(piece[1:])
    found = np.array(states)[: len(command)]
    return found[:, 0], found[:, 4] - found[:, 5]


def van_der_pol_plant(command, sample_period, alpha=0.96, gamma=1.23, initial=(0.0, 0.0)) -> np.ndarray:
    """Simulate equation (10) of the paper over a command [time] held between samples; x1 and x2, [time, 2]."""
    state = np.asarray(initial, dtype=float)
    states = [state]
    for first, last, u, _ in _straight_pieces(np.asarray(command, dtype=float), sample_period, "zero"):

        def derivative(t, y, u=u):
            return alpha * y[1], -y[0] + gamma * (1.0 - y[0] ** 2) * y[1] + u

        piece = _integrated(derivative, state, np.arange(last - first + 1) * sample_period, "DOP853", 1e-12, 1e-12)
        state = piece[-1]
        states.extend(piece[1:])
    return np.array(states)[: len(command)]


def _straight_pieces(command, sample_period, hold):
    """Yield (first sample, last sample, command at the first, slope) of the pieces on which it is a straight line."""
    slopes = np.zeros(len(command))
    if hold == "linear":
        slopes[:-1] = np.diff(command) / sample_period
        apart = np.abs(np.diff(slopes)) > 1e-9 * np.abs(slopes).max()
    else:
        apart = np.diff(command) != 0
    edges = [0, *(np.flatnonzero(apart) + 1).tolist(), len(command)]
    for first, last in itertools.pairwise(edges):
        yield first, last, float(command[first]), float(slopes[first])


def _integrated(derivative, state, times, method, rtol, atol):
    """States at the times, [time, state]."""
    if method == "LSODA":

        def listed(t, y):
            return derivative(t, y.tolist())

        with warnings.catch_warnings(action="ignore", category=ODEintWarning):
            found, report = odeint(
                listed, state, times, tfirst=True, rtol=rtol, atol=atol, mxstep=100_000, full_output=True
            )
        if report["message"] == "Integration successful.":
            return found
        # Where it cannot go on in lock, Radau does, fifty times as slowly.
        method = "Radau"
    found = solve_ivp(
        lambda t, y: derivative(t, y.tolist()),
        times[[0, -1]],
        state,
        method=method,
        t_eval=times,
        rtol=rtol,
        atol=atol,
    )
    assert found.success, found.message
    return found.y.T


def _initial_state(valve, command):
    """Position and filter as given, the load in balance with its spring, the velocity that the flow then gives."""
    x = valve.initial_position
    pressure = valve.stiffness * x / valve.piston_area
    xv = _opening(valve, command, valve.initial_filtered)
    flow = valve.flow_gain * xv * _signed_root(valve.supply_pressure - np.sign(xv) * pressure)
    velocity = (flow - valve.leakage_coefficient * pressure) / valve.piston_area
    state = [x, velocity, valve.initial_filtered, valve.initial_filtered_rate]
    return np.array([*state, pressure] if valve.hydraulic_capacitance else state)


def _opening(valve, command, filtered):
    """Dead zone, then saturation, m."""
    spool = command - filtered if valve.transfer_function == "return" else filtered
    beyond = max(abs(spool) - valve.dead_zone, 0.0)
    return math.copysign(min(beyond, valve.saturation), spool)


def _signed_root(pressure):
    return math.copysign(math.sqrt(abs(pressure)), pressure)


def _equations(valve, floor, start, slope):
    """Return derivative(t, state) and load_pressure(t, state) for the command start + slope*t."""
    area, supply, leakage = valve.piston_area, valve.supply_pressure, valve.leakage_coefficient
    capacitance, flow_gain = valve.hydraulic_capacitance, valve.flow_gain
    gain, omega, damping = valve.feedback_gain, valve.natural_frequency, valve.damping_ratio
    # Steady flow force per opening and pressure, 2 Cv cos(69 deg) w Cd with w Cd = H sqrt(rho): both orifices of the
    # open side, with half of the drop across each. In strokes of the spool.
    force = 2 * 0.98 * math.cos(math.radians(69)) * flow_gain * math.sqrt(valve.oil_density) / valve.spool_stiffness
    if not valve.flow_force:
        force = 0.0

    def incompressible_pressure(velocity, xv):
        """Solve A v + Ct PL = H xv r with PL = s*Ps - w|w|, w = s*r the signed root of the drop."""
        side = min(max(xv / floor, -1.0), 1.0)
        conductance = flow_gain * max(abs(xv), floor)
        flow = area * velocity + leakage * side * supply
        w = 2.0 * flow / (conductance + math.sqrt(conductance**2 + 4.0 * leakage * abs(flow)))
        return side * supply - w * abs(w)

    def drive(command, x):
        if valve.open_loop:
            return command
        if valve.transfer_function == "valve":
            return command - gain * x
        if valve.transfer_function == "forward":
            return gain * (command - x)
        return gain * x

    def derivative(t, state):
        x, v, p, p_rate = state[:4]
        command = start + slope * t
        xv = _opening(valve, command, p)
        pressure = state[4] if capacitance else incompressible_pressure(v, xv)
        drop = supply - math.copysign(1.0, xv) * pressure
        e = drive(command, x) - force * xv * drop
        acceleration = (area * pressure - valve.stiffness * x) / valve.mass
        rates = [v, acceleration, p_rate, omega**2 * (e - p) - 2.0 * damping * omega * p_rate]
        if capacitance:
            rates.append((flow_gain * xv * _signed_root(drop) - area * v - leakage * pressure) / capacitance)
        return rates

    def load_pressure(t, state):
        if capacitance:
            return state[4]
        return incompressible_pressure(state[1], _opening(valve, start + slope * t, state[2]))

    return derivative, load_pressure
