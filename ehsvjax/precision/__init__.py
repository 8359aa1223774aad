"""How sure: standard errors, identifiable directions, intervals, bands, and what an experiment would give."""

from ehsvjax.precision.bands import Band
from ehsvjax.precision.bootstrap import Bootstrap
from ehsvjax.precision.design import cramer_rao_bound, design
from ehsvjax.precision.directions import Combination, Direction
from ehsvjax.precision.profile import Profile, ProfileLikelihood
from ehsvjax.precision.standard_errors import Precision

__all__ = [
    "Band",
    "Bootstrap",
    "Combination",
    "Direction",
    "Precision",
    "Profile",
    "ProfileLikelihood",
    "cramer_rao_bound",
    "design",
]
