"""Wrong values for every argument of the public face, by what the argument should have been."""

import tempfile
from collections.abc import Iterator

import jax
import numpy as np

import ehsvjax
from benchmarks.damaged_calls import Call, damaged
from benchmarks.damaged_models import tank, tank_record
from ehsvjax import __main__ as demo
from ehsvjax import effects, excitation, hydraulics, integrators, operators, paper

NAN, INF = float("nan"), float("inf")
NOT_ANYTHING = {"None": None, "object": object(), "function": print}
TEXTS = {"text": "20", "empty text": ""}
NOT_FINITE = {"NaN": NAN, "inf": INF, "-inf": -INF}
NOT_NUMBERS = {"True": True, "complex": 1j, "list": [1.0, 2.0], "mapping": {"a": 1.0}, "array": np.ones((2, 3))}

NUMBER = NOT_ANYTHING | TEXTS | NOT_FINITE | NOT_NUMBERS
POSITIVE = NUMBER | {"negative": -1.0, "zero": 0.0}
NOT_NEGATIVE = NUMBER | {"negative": -1.0}
SHARE = NOT_NEGATIVE | {"huge": 1e300, "above 1": 1.5}
# What is divided into samples, or counted, can be too large to be meant.
TIME = POSITIVE | {"huge": 1e300}
WHOLE = POSITIVE | {"fraction": 2.5, "huge": 10**18}
WHOLE_FROM_ZERO = NOT_NEGATIVE | {"fraction": 2.5, "huge": 10**18}
FLAG = NOT_ANYTHING | TEXTS | {"NaN": NAN, "number": 2.5, "list": [], "array": np.ones(3)}
NAME = NOT_ANYTHING | {
    "empty": "",
    "blank": "  ",
    "blanks around it": " x ",
    "line break": "a\nb",
    "number": 3.0,
    "list": ["x"],
    "True": True,
}
CHOICE = NOT_ANYTHING | TEXTS | {"number": 3.0, "list": ["x"], "array": np.ones(2), "capital": "ESTIMATE "}
KEY = (
    NOT_ANYTHING
    | TEXTS
    | {"number": 3, "list": [0, 1], "NaN": NAN, "array": np.ones(2), "keys": jax.random.key(0)[None]}
)
FUNCTION = {"None": None, "object": object(), "text": "sin", "number": 3.0, "list": [], "mapping": {}}
THING = NOT_ANYTHING | TEXTS | {"number": 3.0, "list": [], "list of numbers": [1.0], "mapping": {"a": 1.0}}
MAPPING = {"object": object(), "function": print, "text": "gain", "number": 3.0, "list": ["gain"], "set": {"gain"}}
QUANTITY = NOT_ANYTHING | TEXTS | {"list of text": ["a", "b"], "mapping": {"a": 1.0}, "complex": 1j}
PATH = {"object": object(), "number": 3.5, "list": [], "no such folder": "/nowhere/at/all/file", "a folder": "/tmp"}


def without(wrong: dict, *labels: str) -> dict:
    """Return the wrong values without those that may be meant here."""
    return {label: value for label, value in wrong.items() if label not in labels}


def values_of(name: str) -> dict:
    """Return wrong values for a mapping from names to numbers."""
    return MAPPING | {
        "unknown name": {"nobody": 1.0},
        "number as name": {3: 1.0},
        "NaN in it": {name: NAN},
        "inf in it": {name: INF},
        "text in it": {name: "1.0"},
        "None in it": {name: None},
        "list in it": {name: [1.0, 2.0]},
        "True in it": {name: True},
    }


def priors_of(name: str) -> dict:
    """Return wrong values for a mapping from names to means and standard deviations."""
    return MAPPING | {
        "unknown name": {"nobody": (1.0, 1.0)},
        "one number": {name: 1.0},
        "three numbers": {name: (1.0, 2.0, 3.0)},
        "texts in it": {name: ("1", "2")},
        "NaN in it": {name: (NAN, 2.0)},
        "negative": {name: (1.0, -1.0)},
        "no deviation": {name: (1.0, 0.0)},
        "inf in it": {name: (1.0, INF)},
    }


def ties_of(name: str) -> dict:
    """Return wrong values for a mapping from names to functions of all parameters."""
    return MAPPING | {
        "unknown name": {"nobody": lambda p: 1.0},
        "a number in it": {name: 2.0},
        "takes nothing": {name: lambda: 1.0},
        "gives a list": {name: lambda p: [1.0, 2.0]},
        "gives a text": {name: lambda p: "1"},
        "gives NaN": {name: lambda p: NAN},
        "of what is not there": {name: lambda p: p["nobody"]},
        "divides by zero": {name: lambda p: 1.0 / 0.0},
    }


def bounds_of(name: str) -> dict:
    """Return wrong values for a mapping from names to bounds."""
    return MAPPING | {
        "unknown name": {"nobody": (1.0, 2.0)},
        "one number": {name: 1.0},
        "three numbers": {name: (1.0, 2.0, 3.0)},
        "text in it": {name: "12"},
        "texts in it": {name: ("1", "2")},
        "NaN in it": {name: (NAN, 2.0)},
        "inf in it": {name: (1.0, INF)},
        "swapped": {name: (2.0, 1.0)},
        "None in it": {name: None},
        "complex in it": {name: (1j, 2.0)},
    }


def calls() -> Iterator[Call]:
    """Yield a right call of every function that makes signals, operators, models and effects, or simulates them.

    Behind each comes one for each wrong value of each argument.
    """
    for room in (of_excitation, of_operators, of_models, of_hydraulics, of_effects, of_simulation):
        yield from room()


def of_excitation() -> Iterator[Call]:
    """Yield calls of the test signals."""
    key, unit = jax.random.key(0), {"amplitude": (1.0, POSITIVE)}
    timing = {"duration": (1.0, TIME), "sample_period": (0.01, POSITIVE | {"huge": 1e300, "tiny": 1e-300})}
    holds = without(TIME, "list") | {
        "three": [1.0, 2.0, 3.0],
        "swapped": (0.2, 0.1),
        "texts": ["a", "b"],
        "short": 1e-9,
    }
    drawn = {"key": (key, KEY), **unit, "hold_time": (0.1, without(holds, "huge")), **timing, "offset": (0.0, NUMBER)}
    lines = NOT_ANYTHING | TEXTS | NOT_FINITE | {
        "empty": [], "texts": ["a"], "twice": [1.0, 1.0], "too high": [60.0], "square": np.ones((2, 2)),
        "negative": [-1.0], "mapping": {1.0: 2.0}, "complex": [1j], "True": True,
    }  # fmt: skip
    yield from damaged("pseudo_random_signal", excitation.pseudo_random_signal, drawn)
    yield from damaged("pseudo_random_binary_signal", excitation.pseudo_random_binary_signal, drawn)
    yield from damaged("multisine", excitation.multisine,
        {"key": (key, KEY), **unit, "frequencies_hz": ([1.0, 2.0], lines), **timing,
         "phases": ("random", CHOICE)})  # fmt: skip
    yield from damaged("staircase", excitation.staircase,
        {**unit, "levels": (5, WHOLE | {"one": 1}), "hold_time": (0.1, TIME),
         "sample_period": (0.01, POSITIVE | {"huge": 1e300, "tiny": 1e-300})})  # fmt: skip
    sweep = {"start_frequency": (1.0, TIME), "stop_frequency": (20.0, TIME)}
    yield from damaged("chirp", excitation.chirp, {**unit, **sweep, **timing, "method": ("linear", CHOICE)})
    yield from damaged("sample_times", excitation.sample_times, timing)


def of_operators() -> Iterator[Call]:
    """Yield calls of the genetic operators."""
    optional = without(SHARE, "None")
    numbers = {
        "blend_crossover": {"extent": (0.5, SHARE)},
        "line_crossover": {"extent": (0.25, SHARE)},
        "simulated_binary_crossover": {"distribution_index": (2.0, NOT_NEGATIVE), "probability": (0.5, SHARE)},
        "differential_crossover": {"weight": (0.5, SHARE | {"zero": 0.0})},
        "gaussian_mutation": {
            "deviation": (0.1, SHARE | {"zero": 0.0}),
            "probability": (0.5, optional),
            "final_deviation": (0.01, optional | {"zero": 0.0}),
        },
        "polynomial_mutation": {"distribution_index": (20.0, NOT_NEGATIVE), "probability": (0.5, optional)},
        "tournament_selection": {"size": (2, WHOLE)},
        "rank_selection": {"pressure": (1.8, POSITIVE | {"huge": 1e300})},
    }
    for name, arguments in numbers.items():
        yield from damaged(name, getattr(operators, name), arguments)
    individuals, cost = jax.numpy.full((6, 2), 0.5), jax.numpy.arange(6.0)
    arrays = NOT_ANYTHING | TEXTS | {"number": 3.0, "one axis": np.ones(3), "texts": ["a"], "wider": np.ones((6, 5))}
    costs = NOT_ANYTHING | TEXTS | {"number": 3.0, "two axes": np.ones((6, 2)), "short": np.ones(2)}
    yield from damaged("immigrants", operators.immigrants,
        {"key": (jax.random.key(0), KEY), "population": (individuals, without(arrays, "wider")),
         "count": (2, WHOLE_FROM_ZERO | {"too many": 7})})  # fmt: skip
    yield from damaged("elitism", operators.elitism,
        {"key": (jax.random.key(0), KEY), "population": (individuals, arrays), "cost": (cost, costs),
         "elites": (individuals[:1], arrays), "elite_cost": (cost[:1], costs)})  # fmt: skip


def of_models() -> Iterator[Call]:
    """Yield calls that make models of the package, and parts of one's own."""
    constants = ("piston_area", "supply_pressure", "mass")
    may_be_zero = ("stiffness", "hydraulic_capacitance", "leakage_coefficient")
    right = {c.name: c.value for c in ehsvjax.servovalve().parameters}
    yield from damaged("servovalve", ehsvjax.servovalve, {
        **{name: (right[name], POSITIVE | {"huge": 1e300}) for name in constants},
        **{name: (right[name], NOT_NEGATIVE | {"huge": 1e300}) for name in may_be_zero},
        "transfer_function": ("valve", CHOICE), "open_loop": (False, FLAG), "flow_force": (True, FLAG),
        "spool_stiffness": (1e6, POSITIVE | {"huge": 1e300}), "oil_density": (850.0, POSITIVE | {"huge": 1e300}),
    })  # fmt: skip
    nominal = POSITIVE | {"huge": 1e300}
    yield from damaged("van_der_pol", ehsvjax.van_der_pol, {"alpha": (0.96, nominal), "gamma": (1.23, nominal)})

    def with_parameter(**fields):
        return tank(parameters=(ehsvjax.Parameter(**fields), tank().parameters[1]))

    bound = NUMBER
    yield from damaged("Parameter", with_parameter, {
        "name": ("gain", NAME), "symbol": ("k", without(NAME, "empty", "blank", "blanks around it")),
        "unit": ("", without(NAME, "empty", "blank", "blanks around it")),
        "value": (2.0, NUMBER | {"outside": 9.0}), "lower": (1.0, bound | {"above": 3.0}),
        "upper": (3.0, bound | {"below": 0.0}), "scale": ("log", CHOICE), "fixed": (False, FLAG),
        "output": ("level", without(CHOICE, "None")),
    })  # fmt: skip

    def with_signal(**fields):
        return tank(signals=(*tank().signals, ehsvjax.Signal(**fields)))

    kinds = {"senzor": "senzor", "Sensor": "Sensor", "inputs": "inputs", "forse": "forse"}
    yield from damaged("Signal", with_signal, {
        "name": ("leak", NAME | {"there already": "level"}), "kind": ("sink", without(NAME) | kinds),
        "unit": ("", without(NAME, "empty", "blank", "blanks around it")),
    })  # fmt: skip
    parts = {"None": None, "object": object(), "text": "gain", "number": 3.0, "numbers": (1.0, 2.0), "texts": ("a",)}
    own = tank()
    yield from damaged("Model", ehsvjax.Model, {
        "name": ("tank", NAME), "parameters": (own.parameters, parts | {"not in a tuple": own.parameters[0]}),
        "initial": (own.initial, parts), "signals": (own.signals, parts | {"none": ()}),
        "start": (own.start, FUNCTION), "stepper": (own.stepper, FUNCTION), "measure": (own.measure, FUNCTION),
        "max_step": (0.1, POSITIVE), "options": ((), without(parts, "none")),
        "prepare": (None, without(FUNCTION, "None")),
    })  # fmt: skip
    yield from damaged("Model.with_bounds", own.with_bounds, {
        "bounds": ({"gain": (1.0, 3.0)}, bounds_of("gain")), "fixed": ({"lag": 1.0}, values_of("lag")),
    })  # fmt: skip
    yield from damaged("Model.parameter", own.parameter, {"name": ("gain", NAME)})
    yield from damaged("Model.unit", own.unit, {"signal": ("level", NAME)})
    yield from damaged("runge_kutta_4", integrators.runge_kutta_4, {"derivative": (abs, FUNCTION)})


def of_hydraulics() -> Iterator[Call]:
    """Yield calls of the steady hydraulics, with what is no quantity."""
    for function in (
        hydraulics.orifice_flow,
        hydraulics.valve_flow_gain,
        hydraulics.load_flow,
        hydraulics.flow_gain_coefficient,
        hydraulics.flow_pressure_coefficient,
        hydraulics.linearised_load_flow,
        hydraulics.steady_flow_force,
        hydraulics.flow_force_stiffness,
        hydraulics.continuity_flow,
        hydraulics.constant_chamber_flow,
        hydraulics.hydraulic_capacitance,
        hydraulics.signed_sqrt,
    ):
        names = [n for n in function.__annotations__ if n != "return"]
        yield from damaged(f"hydraulics.{function.__name__}", function, {name: (0.5, QUANTITY) for name in names})
        if len(names) > 1:
            shapes = {name: np.ones(2 + (i == 0)) for i, name in enumerate(names)}
            yield Call(f"hydraulics.{function.__name__}", "all", "lengths 3 and 2", lambda f=function, s=shapes: f(**s))
    curves = QUANTITY | {"number": 0.5, "square": np.ones((2, 2))}
    yield from damaged("hydraulics.normalised_pressure_flow_curves", hydraulics.normalised_pressure_flow_curves,
        {"spool_fractions": (np.ones(2), curves), "pressure_fractions": (np.ones(3), curves)})  # fmt: skip


def of_effects() -> Iterator[Call]:
    """Yield calls that make effects and attach them."""
    valve = ehsvjax.servovalve()
    bounds = {"sensor_bias@position.bias": (-1e-3, 1e-3)}
    yield from damaged("effects.attach", effects.attach, {
        "model": (valve, THING), "bounds": (bounds, {"empty": {}, **bounds_of("sensor_bias@position.bias")}),
        "duration": (4.0, POSITIVE), "bank": (effects.BANK, THING),
    })  # fmt: skip
    own = effects.amplitude("force", "{value}", lambda scales: 1.0)
    texts = without(NAME, "empty", "blank", "blanks around it")
    yield from damaged("Effect", ehsvjax.Effect, {
        "name": ("sticking", NAME | {"with @": "a@b"}),
        "kind": ("force", NAME | {"forse": "forse", "senzor": "senzor"}),
        "parameters": ((own,), {"None": None, "object": object(), "text": "a", "number": 3.0, "none": (), "one": own,
                                "numbers": (1.0,), "twice": (own, own)}),
        "apply": (lambda own, value, context: value, FUNCTION),
        "needs": ((), {"None": None, "text": "velocity", "numbers": (1.0,), "number": 3.0}),
        "memory": ((), {"None": None, "text": "a", "texts": ("a",), "number": 3.0}),
        "says": ("", without(texts, "line break")), "settled_by": ("", without(texts, "line break")),
    })  # fmt: skip
    bound = {"lower": (lambda s: 0.0, FUNCTION), "upper": (lambda s: 1.0, FUNCTION)}
    number = {"name": ("force", NAME), "unit": ("N", texts)}
    probe = {"probe": (lambda s: 1.0, FUNCTION)}
    tries = NOT_ANYTHING | {"text": "12", "number": 3.0, "empty": [], "texts": ["a"], "NaN": [NAN], "negative": [-1.0]}

    def made(make):
        return lambda **arguments: ehsvjax.Effect(
            "sticking", "force", (make(**arguments), own._replace(name="other")), abs
        )

    yield from damaged("effects.amplitude", made(effects.amplitude), number | probe | bound)
    yield from damaged("effects.size", made(effects.size), number | probe | {"upper": bound["upper"]})
    yield from damaged("effects.width", made(effects.width), number | {"tries": ([0.1], tries)})
    yield from damaged("effects.limit", made(effects.limit),
        number | {"tries": ([0.5], tries), "lower": (0.02, NOT_NEGATIVE | {"huge": 1e300})})  # fmt: skip
    yield from damaged("effects.shape", made(effects.shape), number | {"tries": (lambda s: [1.0], FUNCTION)} | bound)
    contexts = {"load_force": ("position", "velocity")}
    yield from damaged("effects.candidates", effects.candidates, {
        "model": (valve, THING), "bank": (effects.BANK, without(THING, "list")),
        "contexts": (contexts, MAPPING | {"None": None}),
        "observed": (("position",), without(THING, "list", "mapping")),
    })  # fmt: skip
    yield from damaged("effects.effects_of", effects.effects_of, {"model": (valve, THING)})


def of_simulation() -> Iterator[Call]:
    """Yield calls that simulate, and that plan experiments."""
    model, record = tank(), tank_record()
    values = {"parameters": ({"gain": 2.0}, values_of("gain"))}
    yield from damaged("simulate", ehsvjax.simulate, {
        "model": (model, THING), "record": (record, THING), **values, "initial": ({"start": 0.0}, values_of("start")),
        "substeps": (2, without(WHOLE, "None")), "signal": (lambda name, value, **context: value, FUNCTION),
    })  # fmt: skip
    signals = {"text": "flow", "number": 3.0, "numbers": [1.0], "unknown": ["nobody"], "empty": [], "object": object()}
    yield from damaged("linearise", ehsvjax.linearise, {
        "model": (model, THING), "at": ({"command": 0.5}, values_of("command")), **values,
        "initial": ({"start": 0.0}, values_of("start")),
        "inputs": (["command"], signals), "outputs": (["flow"], signals),
    })  # fmt: skip
    variances = without(values_of("level"), "None") | {
        "None": None,
        "zero": {"level": 0.0},
        "negative": {"level": -1.0},
    }
    for function in (ehsvjax.design, ehsvjax.cramer_rao_bound):
        yield from damaged(function.__name__, function, {
            "model": (model, THING), "records": (record, THING),
            "noise_variance": ({"level": 1e-4}, variances | {"empty": {}}),
            **values, "initial_values": ({"start": 0.0}, values_of("start")),
        })  # fmt: skip
    yield from damaged("paper.van_der_pol_record", paper.van_der_pol_record,
        {"key": (jax.random.key(0), KEY), "noise_variance": (0.05, NOT_NEGATIVE)})  # fmt: skip
    yield from damaged("paper.table_1", paper.table_1, {"identifications": ([], without(THING, "list"))})
    with tempfile.NamedTemporaryFile(delete=False) as file:
        pass
    for label, arguments in {
        "a file as folder": ["--out", file.name],
        "a folder that cannot be": ["--out", f"{file.name}/below"],
        "a folder that cannot be written": ["--out", "/proc/here"],
        "text as seed": ["--seed", "three"],
        "huge seed": ["--seed", str(10**30)],
        "negative seed": ["--seed", "-1"],
        "unknown option": ["--seeds", "1"],
        "no value": ["--out"],
    }.items():
        yield Call("python -m ehsvjax", "", label, lambda a=arguments: demo.main(a))
