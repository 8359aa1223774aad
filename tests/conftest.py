"""Strict JAX and checked shapes, under test only: users pay for neither."""

import os
from pathlib import Path

# Before NumPy is imported, and for the workers: threads of OpenBLAS that wait for each other in several processes at
# once take half of the machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Half of the tests' time is compiling, and workers and processes would compile much of it again. Delete the folder to
# have everything compiled anew.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import jax
import jaxtyping
import pytest
from beartype import BeartypeConf
from jaxtyping import install_import_hook

jax.config.update("jax_numpy_rank_promotion", "raise")
# Two devices, so that sharing work between them is tested on any machine.
jax.config.update("jax_num_cpu_devices", 2)

# PEP 484's numeric tower: an int may stand where a float is asked for.
_typechecker = "tests.conftest.checked"


def _install():
    import beartype

    global checked
    checked = beartype.beartype(conf=BeartypeConf(is_pep484_tower=True))


_install()
install_import_hook("ehsvjax", _typechecker)


@pytest.fixture
def unchecked(monkeypatch):
    """Let wrong types through to the package's own checks, as they are for a user."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
