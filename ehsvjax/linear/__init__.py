"""The linear model of small deviations from an operating point: state space, poles, frequency response."""

from ehsvjax.linear.model import LinearModel
from ehsvjax.linear.recipe import linearise

__all__ = ["LinearModel", "linearise"]
