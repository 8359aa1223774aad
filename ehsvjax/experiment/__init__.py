"""The next experiment, designed: which record would tell explanations apart that the records so far cannot."""

from ehsvjax.experiment.limits import Limits
from ehsvjax.experiment.plan import Option, Plan
from ehsvjax.experiment.recipe import next_experiment

__all__ = ["Limits", "Option", "Plan", "next_experiment"]
