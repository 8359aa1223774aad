"""What else is done with a residual: the peers of diagnosis_peers.py, each as its own field would use it.

Every method takes a fit and the record that it was fitted to, and answers whether something is left and, if it can say
so, what. Names are judged kindly: a term or a quantity may mean any effect that acts through it.
"""

import warnings
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.signal import lsim, savgol_filter
from scipy.stats import norm

import ehsvjax


class Answer(NamedTuple):
    """What a method answers.

    Attributes:
        inadequate: it sees that something is left.
        terms: those that it names, the strongest first.
        meant: the effects that each can mean.

    """

    inadequate: bool
    terms: tuple[str, ...] = ()
    meant: tuple[frozenset[str], ...] = ()


# Correlation of residuals ------------------------------------------------------------------------------------------

_LAGS, _CONFIDENCE = 25, 0.99  # those that MATLAB's `resid` draws


def correlation_test(fit: ehsvjax.Fit, record: ehsvjax.Record) -> Answer:
    """Judge by the residual's correlation with itself and with the input, as MATLAB's `resid` shows it.

    One in a hundred crosses its bound by chance: as many as a binomial distribution allows are let pass.
    """
    residual = fit.residuals(record)["position"]
    residual = residual - residual.mean()
    (command,) = record.inputs.values()
    command = command - command.mean()
    count = len(residual)
    bound = norm.ppf(0.5 + 0.5 * _CONFIDENCE) / np.sqrt(count)
    itself = np.array([residual[k:] @ residual[: count - k] for k in range(1, _LAGS + 1)]) / (residual @ residual)
    size = np.sqrt((residual @ residual) * (command @ command))
    # Against white residuals; the input's own correlation does not change the variance at a lag.
    crossed = np.array([residual[k:] @ command[: count - k] for k in range(_LAGS + 1)]) / size
    allowed = 4  # of 51: P(more | nothing left) < 1e-3 for independent lags
    return Answer(int((np.abs(itself) > bound).sum() + (np.abs(crossed) > bound).sum()) > allowed)


# A Gaussian process on the residual --------------------------------------------------------------------------------

_THINNED, _CONVINCING = 400, 10.0  # samples; of log marginal likelihood, strong evidence on any scale
_ACTS_THROUGH: Mapping[str, str] = {
    "position": "hardening_spring end_stop sensor_saturation sensor_cubic sensor_gain sensor_quantisation "
    "sensor_asymmetry cubic_stiffness quintic_stiffness quadratic_stiffness damping_threshold asymmetric_damping "
    "elastic_friction",
    "velocity": "coulomb_friction stribeck_friction viscous_friction area_asymmetry area_ratio sensor_lag "
    "linear_damping feedback_backlash torque_motor_hysteresis transport_delay supply_droop structural_flexibility "
    "rayleigh_damping quadratic_damping asymmetric_damping damping_threshold input_lag one_way_damping "
    "elastic_friction",
    "command": "input_gain input_lag input_dead_zone input_saturation transport_delay",
    "spool": "null_bias asymmetric_dead_zone null_leakage flow_gain_rounding flow_gain_curvature spool_rate_limit "
    "torque_motor_hysteresis",
    "load_pressure": "cross_piston_leakage oil_compressibility supply_droop return_pressure structural_flexibility "
    "coulomb_friction constant_load constant_force viscous_friction",
    "time": "sensor_drift flow_gain_drift parameter_drift harmonic_load harmonic_force parametric_excitation "
    "process_noise",
}


def gaussian_process(fit: ehsvjax.Fit, record: ehsvjax.Record) -> Answer:
    """Regress the residual on what the model simulates; name the quantity with which it varies fastest.

    Automatic relevance determination: Rasmussen & Williams 2006, section 5.1. The evidence is against noise alone.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    simulated = fit.simulate(record)
    quantities = {**simulated, **record.inputs, "time": record.time}
    quantities["velocity"] = np.gradient(simulated["position"], record.sample_period)
    names = [name for name in _ACTS_THROUGH if name in quantities]
    thin = np.linspace(0, len(record) - 1, _THINNED).astype(int)
    features = np.stack([quantities[name][thin] for name in names], axis=1)
    features = (features - features.mean(axis=0)) / features.std(axis=0)
    residual = fit.residuals(record)["position"][thin]
    residual = (residual - residual.mean()) / residual.std()
    kernel = ConstantKernel(0.5, (1e-3, 1e2)) * RBF(np.ones(len(names)), (1e-2, 1e3)) + WhiteKernel(0.5, (1e-6, 10.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a length at its bound says that its quantity does not matter
        process = GaussianProcessRegressor(kernel, random_state=0, n_restarts_optimizer=1).fit(features, residual)
    noise_alone = -0.5 * _THINNED * (np.log(2.0 * np.pi) + 1.0)
    if process.log_marginal_likelihood_value_ < noise_alone + _CONVINCING:
        return Answer(False)
    order = np.argsort(process.kernel_.k1.k2.length_scale)
    return Answer(True, (names[order[0]],), (frozenset(_ACTS_THROUGH[names[order[0]]].split()),))


# Sparse regression on the discrepancy ------------------------------------------------------------------------------

_THRESHOLDS = np.geomspace(1e-3, 1.0, 30)  # of coefficients, in deviations of the discrepancy
_WINDOW = {
    "servovalve": 0.1,
    "Van der Pol oscillator": 0.5,
}  # s, of a cubic that is fitted to the residual for its derivatives
_TAKEN = 10  # terms at most, of a forward regression
_RIDGE = 1e-6

Columns = dict[str, tuple[np.ndarray, str]]


class Discrepancy(NamedTuple):
    """What a model's equation lacks along a record, `[time]`, and what it could be.

    `columns` are terms with the effects that they can mean, `nominal` what the model's own parameters can do.
    """

    term: np.ndarray
    columns: Columns
    nominal: tuple[np.ndarray, ...]
    window: int


def thresholded_regression(fit: ehsvjax.Fit, record: ehsvjax.Record) -> Answer:
    """Name the terms that sequentially thresholded least squares keeps; see `_sparse`."""
    import pysindy

    def path(library, target):
        for threshold in _THRESHOLDS:
            yield pysindy.STLSQ(threshold=threshold, alpha=_RIDGE, max_iter=30).fit(library, target).coef_[0]

    return _sparse(fit, record, path)


def forward_regression(fit: ehsvjax.Fit, record: ehsvjax.Record) -> Answer:
    """Name the terms that forward regression with orthogonal least squares takes first; see `_sparse`."""
    import pysindy

    def path(library, target):
        for taken in pysindy.FROLS(max_iter=_TAKEN, alpha=_RIDGE, verbose=False).fit(library, target).history_:
            yield np.ravel(taken)

    return _sparse(fit, record, path)


def _sparse(fit: ehsvjax.Fit, record: ehsvjax.Record, path: Callable) -> Answer:
    """Regress what the fitted equation lacks on a library of terms, as SINDy does, along a path of sparsity.

    Brunton, Proctor & Kutz 2016; on the discrepancy of a known model, Kaheman et al. 2019. The library has a term for
    what each effect of the bank adds to the equation, to first order; what the model's parameters can do is projected
    out; of the path the least BIC is taken. The equation is that of the residual, linear about the simulation, so
    that only the residual has to be differentiated: derivatives of the readings are biased by more than what is sought.
    """
    found = (_of_valve if fit.model.name == "servovalve" else _of_oscillator)(fit, record)
    inner = slice(found.window, len(record) - found.window)

    def seen(column):
        return savgol_filter(column, found.window, 3)[inner]

    nominal = np.linalg.qr(np.stack([seen(column) for column in found.nominal], axis=1))[0]

    def beside(column):
        return column - nominal @ (nominal.T @ column)

    target = beside(found.term[inner])
    target = target / target.std()
    seen_columns = {name: beside(seen(column)) for name, (column, _) in found.columns.items()}
    sizes = {name: np.sqrt((column**2).mean()) for name, column in seen_columns.items()}
    names = [name for name, size in sizes.items() if size > 1e-9 * np.sqrt((found.columns[name][0] ** 2).mean())]
    library = np.stack([seen_columns[name] / sizes[name] for name in names], axis=1)
    # A sine and a cosine share a frequency, which was fitted too.
    numbers = np.array([1.5 if name.endswith("sine") else 1.0 for name in names])
    # Neighbours share their readings: a cubic over a window averages as many as 4/9 of them do.
    independent = 2.25 * len(target) / found.window

    def score(coefficients):
        left = target - library @ coefficients
        return independent * np.log((left**2).mean()) + np.log(independent) * numbers[coefficients != 0.0].sum()

    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a threshold leaves no term is an answer
        coefficients = min([np.zeros(len(names)), *path(library, target[:, None])], key=score)
    if not coefficients.any():
        return Answer(False)
    order = [i for i in np.argsort(-np.abs(coefficients)) if coefficients[i] != 0.0]
    meant = tuple(frozenset(found.columns[names[i]][1].split()) for i in order)
    return Answer(True, tuple(names[i] for i in order), meant)


def _of_residual(fit, record):
    """Return the residual and its two derivatives, smoothed, `[time]` each, and the window in samples."""
    period = record.sample_period
    window = 2 * round(0.5 * _WINDOW[fit.model.name] / period) + 1
    residual = fit.residuals(record)["position"]
    return [savgol_filter(residual, window, 3, deriv=k, delta=period) for k in range(3)], window


def _of_oscillator(fit, record) -> Discrepancy:
    """Return a force that x'' = alpha*(-x + u) + gamma*(1 - x^2)*x' lacks, over alpha, and terms in it."""
    (r, r_rate, r_second), window = _of_residual(fit, record)
    alpha, gamma = fit.parameters["alpha"], fit.parameters["gamma"]
    x, u, t = fit.simulate(record)["position"], record.inputs["command"], record.time
    v = np.gradient(x, record.sample_period)
    a = alpha * (u - x) + gamma * (1.0 - x**2) * v
    term = (r_second - gamma * ((1.0 - x**2) * r_rate - 2.0 * x * v * r)) / alpha + r
    columns: Columns = {
        "1": (np.ones_like(x), "constant_force sensor_bias"),
        "x": (x, "sensor_gain input_gain"),
        "x^2": (x**2, "quadratic_stiffness"),
        "x^3": (x**3, "cubic_stiffness sensor_cubic"),
        "x^5": (x**5, "quintic_stiffness"),
        "v": (v, "linear_damping damping_threshold"),
        "x^2 v": (x**2 * v, "damping_threshold linear_damping sensor_gain"),
        "x v": (x * v, "asymmetric_damping sensor_bias"),
        "v |v|": (v * np.abs(v), "quadratic_damping"),
        "v^3": (v**3, "rayleigh_damping"),
        "|v|": (np.abs(v), "one_way_damping"),
        "slides at .1": (_sliding(x, 0.1), "elastic_friction"),
        "slides at .4": (_sliding(x, 0.4), "elastic_friction"),
        "|x|": (np.abs(x), "sensor_asymmetry"),
        "sign v": (np.sign(v), "coulomb_friction"),
        "a": (a, "sensor_lag"),
        "u": (u, "input_gain sensor_gain"),
        "u'": (np.gradient(u, record.sample_period), "transport_delay input_lag"),
        "sign u": (np.sign(u), "input_dead_zone"),
        "u beyond .75": (u - np.clip(u, -0.75, 0.75), "input_saturation"),
        "x beyond 1.5": (x - np.clip(x, -1.5, 1.5), "sensor_saturation"),
        "t x": (t * x, "parameter_drift"),
        "t v": (t * v, "parameter_drift"),
        "t u": (t * u, "parameter_drift"),
    }
    columns |= _harmonics(term, record, {"": np.ones_like(x), "x ": x}, "harmonic_force", "parametric_excitation")
    return Discrepancy(term, columns, (u - x, (1.0 - x**2) * v), window)


def _sliding(x, length):
    """Return the stretch of what slides at a length."""
    stretch = np.zeros_like(x)
    for k, way in enumerate(np.diff(x)):
        end = np.sign(way) * length
        stretch[k + 1] = end + (stretch[k] - end) * np.exp(-np.abs(way) / length)
    return stretch


def _of_valve(fit, record) -> Discrepancy:
    """Return a velocity that A*v = H*xv*sqrt(Ps - sgn(xv)*PL) lacks, and terms in it."""
    p = {one.name: one.value for one in fit.model.parameters} | dict(fit.parameters)
    (r, r_rate, r_second), window = _of_residual(fit, record)
    period, t = record.sample_period, record.time
    simulated = fit.simulate(record)
    x, pressure = simulated["position"], simulated["load_pressure"]
    v = np.gradient(x, period)
    a = np.gradient(v, period)
    w, zeta = p["natural_frequency"], p["damping_ratio"]
    drive = ([w**2], [1.0, 2.0 * zeta * w, w**2])

    def driven(error):
        return lsim(drive, error, t, interp=False)[1]

    spool = driven(record.inputs["command"] - p["feedback_gain"] * x)
    inside = np.clip(spool, -p["dead_zone"], p["dead_zone"])
    opening = np.clip(spool - inside, -p["saturation"], p["saturation"])
    side, open_ = np.sign(opening), (opening != 0.0) & (np.abs(opening) < p["saturation"])
    root = np.sqrt(np.maximum(p["supply_pressure"] - side * pressure, 1e-3 * p["supply_pressure"]))
    flow = p["flow_gain"] * opening * root / p["piston_area"]
    by_opening = p["flow_gain"] * root / p["piston_area"] * open_
    by_force = -0.5 * p["flow_gain"] * np.abs(opening) / root / p["piston_area"] ** 2
    term = r_rate + by_opening * driven(p["feedback_gain"] * r) - by_force * (p["mass"] * r_second + p["stiffness"] * r)
    spool_rate, moves = np.gradient(spool, period), np.sign(v) * (np.abs(v) > 3e-3)
    columns: Columns = {
        "1": (np.ones_like(x), "sensor_drift"),
        "force": (by_force, "constant_load"),
        "force: sign v": (by_force * moves, "coulomb_friction"),
        "force: sign v, slow": (by_force * moves * np.exp(-np.abs(v) / 0.02), "stribeck_friction"),
        "force: v": (by_force * v, "viscous_friction supply_droop"),
        "force: x^3": (by_force * x**3, "hardening_spring"),
        "force: x beyond .03": (by_force * np.maximum(x - 0.03, 0.0), "end_stop"),
        "force: side": (by_force * side, "return_pressure"),
        "opening": (by_opening, "null_bias asymmetric_dead_zone sensor_bias"),
        "opening: sign of its rate": (by_opening * np.sign(spool_rate), "torque_motor_hysteresis"),
        "opening: sign v": (by_opening * moves, "feedback_backlash"),
        "opening: x": (by_opening * driven(x), "sensor_gain"),
        "opening: |x|": (by_opening * driven(np.abs(x)), "sensor_asymmetry"),
        "opening: v": (by_opening * driven(v), "sensor_lag"),
        "opening: command's rate": (by_opening * (driven(np.r_[0.0, np.diff(record.inputs["command"])]) / period),
                                    "transport_delay"),
        "opening: fast rate": (by_opening * np.sign(spool_rate) * np.maximum(np.abs(spool_rate) - 0.3, 0.0),
                               "spool_rate_limit"),
        "opening near its edge": (by_opening * side * np.exp(-np.abs(opening) / 1e-4), "flow_gain_rounding"),
        "inside the dead zone": (inside * (opening == 0.0), "null_leakage"),
        "|flow|": (np.abs(flow), "area_asymmetry area_ratio"),
        "flow opening^2": (flow * opening**2, "flow_gain_curvature"),
        "flow t": (flow * t, "flow_gain_drift"),
        "pressure": (pressure, "cross_piston_leakage"),
        "its rate": (np.gradient(pressure, period), "oil_compressibility structural_flexibility"),
        "a": (a, "sensor_lag"),
        "v where x > .03": (v * (x > 0.03), "sensor_saturation end_stop"),
    }  # fmt: skip
    columns |= _harmonics(term, record, {"force: ": by_force}, "harmonic_load")
    nominal = (
        flow,
        by_opening * side,
        p["flow_gain"] * root / p["piston_area"] * side * (np.abs(opening) >= p["saturation"]),
        by_opening * driven(x),
        by_opening * spool_rate,
        by_opening * np.gradient(spool_rate, period),
    )
    return Discrepancy(term, columns, nominal, window)


def _harmonics(left, record, factors, *meanings) -> Columns:
    """Return a sine and a cosine, times each factor, at the frequency of the discrepancy's highest line."""
    columns: Columns = {}
    for (said, factor), meant in zip(factors.items(), meanings, strict=True):
        lines = np.abs(np.fft.rfft((left - left.mean()) * factor))
        # At least two periods.
        frequency = 2.0 * np.pi * (2 + int(lines[2:].argmax())) / (len(left) * record.sample_period)
        columns[f"{said}sine"] = (factor * np.sin(frequency * record.time), meant)
        columns[f"{said}cosine"] = (factor * np.cos(frequency * record.time), meant)
    return columns
