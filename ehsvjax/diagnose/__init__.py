"""What a model gets wrong on measured data, why, and what it would gain: `diagnose`."""

from ehsvjax.diagnose.diagnosis import Alternative, Diagnosis, Excluded
from ehsvjax.diagnose.recipe import diagnose

__all__ = ["Alternative", "Diagnosis", "Excluded", "diagnose"]
