"""The Van der Pol oscillator of the paper's section 3.2, equation (10)."""

from ehsvjax.integrators import runge_kutta_4
from ehsvjax.models.model import Model, Parameter, Signal


def van_der_pol(alpha: float = 0.96, gamma: float = 1.23) -> Model:
    """Return the forced Van der Pol oscillator, equation (10) of the paper.

        x1' = alpha*x2,    x2' = -x1 + gamma*(1 - x1^2)*x2 + u,    y = x1

    Input `command` u, output `position` x1; everything is dimensionless but the time, in s.

    Args:
        alpha: nominal value, 1/s; 0.96 in the paper.
        gamma: nominal value, 1/s; 1.23 in the paper.

    Raises:
        ValueError: if a value lies outside the default bounds, +-50% of the paper's values.

    """
    return Model(
        name="Van der Pol oscillator",
        parameters=(
            Parameter("alpha", "α", "1/s", alpha, 0.48, 1.44),
            Parameter("gamma", "γ", "1/s", gamma, 0.615, 1.845),
        ),
        initial=(
            Parameter("initial_position", "x1(0)", "", 0.0, -3.0, 3.0, output="position"),
            Parameter("initial_velocity", "x2(0)", "", 0.0, -5.0, 5.0),
        ),
        signals=(
            Signal("command", "input", ""),
            Signal("damping", "damping", ""),
            Signal("force", "force", ""),
            Signal("position", "sensor", ""),
        ),
        start=_start,
        stepper=runge_kutta_4(_derivative),
        measure=_measure,
        # Runge-Kutta steps that keep a forced record of 40 s within 1e-6; 0.02 s leaves up to 1.2e-5.
        max_step=0.005,
        options=(("alpha", alpha), ("gamma", gamma)),
    )


def _start(parameters, initial, inputs):
    del parameters, inputs
    return {"x1": initial["initial_position"], "x2": initial["initial_velocity"]}


def _derivative(parameters, state, inputs, signal):
    alpha, gamma = parameters["alpha"], parameters["gamma"]
    u = signal("command", inputs["command"])
    x2 = state["x2"]
    x1 = state["x1"]
    # Where the damping changes its sign; the restoring force keeps x1 itself.
    damping_position = signal("damping", x1)
    force = signal("force", 0.0, position=x1, velocity=x2)
    return {"x1": alpha * x2, "x2": -x1 + gamma * (1.0 - damping_position**2) * x2 + u + force}


def _measure(parameters, state, inputs, signal):
    del parameters, inputs
    return {"position": signal("position", state["x1"], velocity=state["x2"])}
