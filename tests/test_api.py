"""The public face: every name says what it is, importing is cheap and changes nothing, and imports point one way."""

import ast
import importlib
import importlib.metadata
import inspect
import json
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import ehsvjax

PACKAGE = Path(ehsvjax.__file__).parent
MODULES = sorted(m.name for m in pkgutil.walk_packages([str(PACKAGE)], "ehsvjax.") if m.name != "ehsvjax.__main__")


def _public(module):
    return [
        (name, value)
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__ and callable(value)
    ]


def test_all_is_sorted_and_there():
    assert ehsvjax.__all__ == sorted(ehsvjax.__all__)
    for name in ehsvjax.__all__:
        assert getattr(ehsvjax, name).__doc__, name


@pytest.mark.parametrize("name", MODULES)
def test_every_public_name_is_documented(name):
    module = importlib.import_module(name)
    assert module.__doc__, name
    for label, value in _public(module):
        assert inspect.getdoc(value), f"{name}.{label}"
        if inspect.isclass(value):
            for method, function in vars(value).items():
                if not method.startswith("_") and (inspect.isfunction(function) or isinstance(function, property)):
                    assert inspect.getdoc(function), f"{name}.{label}.{method}"


@pytest.mark.parametrize("name", MODULES)
def test_refusals_are_documented(name):
    """A public function that raises says so."""
    tree = ast.parse(Path(importlib.import_module(name).__file__).read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            raises = [n for n in ast.walk(node) if isinstance(n, ast.Raise) and isinstance(n.exc, ast.Call)]
            if raises:
                assert "Error" in (ast.get_docstring(node) or ""), f"{name}.{node.name}"


@pytest.mark.parametrize("room", ["genetic", "islands", "operators", "population", "precision", "refine"])
def test_arrays_of_public_functions_have_their_axes_named(room):
    name = f"ehsvjax.{room}"
    for label, value in _public(importlib.import_module(name)):
        if inspect.isfunction(value):
            for annotation in inspect.get_annotations(inspect.unwrap(value)).values():
                assert str(annotation) not in ("<class 'jax.Array'>", "<class 'numpy.ndarray'>"), f"{name}.{label}"


CHEAP = """
import json, sys
import jax
before = dict(jax.config.values)
import ehsvjax
heavy = ["pandas", "matplotlib.pyplot", "scipy.io", "scipy.signal", "scipy.stats", "jinja2", "tqdm", "IPython"]
heavy = [m for m in heavy if m in sys.modules]
from jax._src import xla_bridge
print(json.dumps({"heavy": heavy, "changed": [k for k, v in jax.config.values.items() if before.get(k, v) != v],
                  "backends": bool(xla_bridge._backends)}))
"""


def test_whatever_is_imported_is_declared():
    """Also what another dependency happens to bring along."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    named = [*project["dependencies"], *project["optional-dependencies"]["files"]]
    declared = {re.split(r"[><=\[ ]", requirement)[0].lower() for requirement in named}
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
            found |= {name.partition(".")[0] for name in names}
    brought_by = importlib.metadata.packages_distributions()
    others = found - set(sys.stdlib_module_names) - {"ehsvjax"}
    assert {name for name in others if not declared & {d.lower() for d in brought_by[name]}} == set()


def test_importing_is_cheap_and_changes_nothing():
    out = subprocess.run([sys.executable, "-c", CHEAP], capture_output=True, text=True, check=True).stdout
    assert json.loads(out) == {"heavy": [], "changed": [], "backends": False}


# What each room must not import at its top level, directly or through others: imports point down only.
NEVER = {
    "record": ("models", "population", "genetic", "identify", "fit"),
    "excitation": ("models", "record", "population", "genetic"),
    "hydraulics": ("models", "record", "population", "genetic"),
    "models.model": ("population", "genetic", "operators", "identify", "simulate", "record"),
    "models.servovalve": ("population", "genetic", "operators", "identify", "record"),
    "models.van_der_pol": ("population", "genetic", "operators", "identify", "record"),
    "integrators": ("models", "population", "genetic", "record", "kernels"),
    "kernels": ("models", "population", "genetic", "record", "simulate"),
    "registers": ("kernels", "models", "population", "genetic", "record", "simulate"),
    "simulate": ("population", "genetic", "operators", "identify"),
    "population": ("genetic", "operators", "search", "identify", "fit"),
    "operators": ("population", "models", "record", "genetic", "simulate"),
    "genetic": ("population", "models", "record", "simulate", "hydraulics"),
    "islands": ("population", "models", "record", "simulate", "hydraulics"),
    "search": ("population", "models", "record", "simulate"),
    "refine": ("genetic", "operators", "search", "identify"),
    "precision": ("genetic", "operators", "search", "identify", "fit"),
    "precision.of_fit": ("genetic", "operators", "search", "identify"),
    "identify": ("plots", "report", "paper", "models.servovalve", "models.van_der_pol"),
    "fit": ("plots", "report", "paper", "population", "genetic"),
}


def _imported(name: str) -> set[str]:
    """Modules of the package that a module imports at its top level, and those that they import."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        tree = ast.parse(Path(importlib.import_module(waiting.pop()).__file__).read_text())
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ehsvjax"):
                for alias in node.names:
                    candidate = f"{node.module}.{alias.name}"
                    target = candidate if candidate in MODULES else node.module
                    if target != "ehsvjax" and target not in found:
                        found.add(target)
                        waiting.append(target)
    return found


@pytest.mark.parametrize(("room", "never"), NEVER.items(), ids=list(NEVER))
def test_imports_point_down_only(room, never):
    assert {f"ehsvjax.{name}" for name in never} & _imported(f"ehsvjax.{room}") == set()
    for top in ("report", "plots", "__main__"):
        assert f"ehsvjax.{top}" not in _imported(f"ehsvjax.{room}")


# The rooms of a diagnosis, from the top down.
ROOMS = ("recipe", "results", "decision", "hypotheses", "bench")


def test_rooms_of_a_diagnosis_import_down_only():
    rooms = {name: name.split(".")[2] for name in MODULES if name.startswith("ehsvjax.diagnosis.")}
    assert set(rooms.values()) == set(ROOMS)
    for name, room in rooms.items():
        above = {other for other in rooms if ROOMS.index(rooms[other]) < ROOMS.index(room)}
        assert not above & _imported(name), name


def test_rooms_of_a_diagnosis_have_no_circles():
    for name in MODULES:
        if name.startswith("ehsvjax.diagnosis."):
            assert name not in _imported(name)
