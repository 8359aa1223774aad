"""Fits and diagnoses in files: every result as plain numbers and text, sealed, without pickled content.

A result is stored as it is built, field by field (`trees`), so that what is added to it is stored too; equations are
code, and are found again by the name of what made them or handed over (`models`).
"""

from ehsvjax.storage.results import load_diagnosis, load_fit, save_diagnosis, save_fit

__all__ = ["load_diagnosis", "load_fit", "save_diagnosis", "save_fit"]
