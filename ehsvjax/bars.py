"""Which progress bar can be shown here."""

import importlib.util
from typing import Any


def progress_bar(**options: Any) -> Any:
    """Return a bar of tqdm, with its options: a notebook's own needs ipywidgets, and would warn without them."""
    if importlib.util.find_spec("ipywidgets"):
        from tqdm.auto import tqdm
    else:
        from tqdm import tqdm
    return tqdm(**options)
