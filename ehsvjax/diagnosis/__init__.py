"""What a model gets wrong on measured data, why, and what it would gain: `diagnose`."""

from ehsvjax.diagnosis.decision.verdict import Alternative
from ehsvjax.diagnosis.recipe import diagnose
from ehsvjax.diagnosis.results.diagnosis import Diagnosis, Excluded

__all__ = ["Alternative", "Diagnosis", "Excluded", "diagnose"]
