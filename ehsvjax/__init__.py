"""ehsvjax identifies electrohydraulic servovalves, and other models, from measured records.

The pipeline, each step usable by itself:

    record = Record.from_csv(...)                    measured data, checked once (`record`)
    model = servovalve(...)                          a block diagram with named signals (`models`)
    fit = identify(model, record, key=...)           genetic search and gradient refinement (`identify`)
    print(fit); fit.plot(); fit.score(other_record)  the result (`fit`)
    fit.precision(); fit.profile_likelihood()        how sure it is (`precision`); before any data: `design`

Axes, wherever a shape is given: record, individual (a candidate of the population), parameter (an unknown, initial
conditions included), generation, time (a sample), signal (an output). SI units throughout.
"""

from ehsvjax import excitation, hydraulics, operators
from ehsvjax.columns import Column
from ehsvjax.fit import Fit
from ehsvjax.genetic import Operators
from ehsvjax.identify import identify
from ehsvjax.integrators import runge_kutta_4
from ehsvjax.models import Model, Parameter, Signal, servovalve, van_der_pol
from ehsvjax.precision import cramer_rao_bound, design
from ehsvjax.record import Record
from ehsvjax.simulate import simulate

__all__ = [
    "Column",
    "Fit",
    "Model",
    "Operators",
    "Parameter",
    "Record",
    "Signal",
    "cramer_rao_bound",
    "design",
    "excitation",
    "hydraulics",
    "identify",
    "operators",
    "runge_kutta_4",
    "servovalve",
    "simulate",
    "van_der_pol",
]
