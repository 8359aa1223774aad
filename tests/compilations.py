"""What JAX compiles, counted."""

import contextlib

import jax


@contextlib.contextmanager
def compilations():
    """Collect what JAX compiles, by the functions' names."""
    names = []

    def note(event, duration, **about):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(about.get("fun_name", "?"))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
