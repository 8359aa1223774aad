"""Which progress bar can be shown here."""

import importlib.util


def bars() -> type:
    """Return tqdm's bar: a notebook's own needs ipywidgets, and would warn without them."""
    if importlib.util.find_spec("ipywidgets"):
        from tqdm.auto import tqdm
    else:
        from tqdm import tqdm
    return tqdm
