"""Models: what one is (`model`), the servovalve and the Van der Pol oscillator of the paper."""

from ehsvjax.models.model import Model, Parameter, Signal, identity
from ehsvjax.models.servovalve import servovalve
from ehsvjax.models.van_der_pol import van_der_pol

__all__ = ["Model", "Parameter", "Signal", "identity", "servovalve", "van_der_pol"]
