"""A bar over the stages of a diagnosis, with the time that is left by what such stages take as a rule."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from ehsvjax.bars import progress_bar

Progress = Callable[[str, float], None]
"""Told of a stage, and of the share of a diagnosis that is done when it begins."""


@contextlib.contextmanager
def bar(shown: bool | None) -> Iterator[Progress]:
    """Show a bar where a person looks on, a terminal or a notebook; or always, or never.

    It goes when the diagnosis is done.
    """
    hidden = not _looked_at() if shown is None else not shown
    layout = "{desc} |{bar}| {percentage:.0f}% [{elapsed}<{remaining}]"
    with progress_bar(total=1.0, desc="diagnose", bar_format=layout, leave=False, disable=hidden) as shown_bar:

        def say(stage: str, done: float) -> None:
            shown_bar.set_description(f"diagnose: {stage}", refresh=False)
            # A stage that is gone through again takes nothing back.
            shown_bar.update(max(done - shown_bar.n, 0.0))
            shown_bar.refresh()

        yield say


def _looked_at() -> bool:
    """Whether a person sees what is written: in a terminal, or in a notebook."""
    shell = sys.modules.get("IPython")
    kernel = shell is not None and "IPKernelApp" in getattr(shell.get_ipython(), "config", {})
    return kernel or sys.stderr.isatty()
