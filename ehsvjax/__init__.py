"""ehsvjax identifies electrohydraulic servovalves, and other models, from measured records.

The pipeline, each step usable by itself:

    record = Record.from_csv(...)                    measured data, checked once (`record`)
    model = servovalve(...)                          a block diagram with named signals (`models`)
    fit = identify(model, record, key=...)           genetic search and gradient refinement (`identify`)
    print(fit); fit.plot(); fit.score(other_record)  the result (`fit`)
    fit.precision(); fit.profile_likelihood()        how sure it is (`precision`); before any data: `design`
    diagnosis = diagnose(fit, record, key=...)       what it gets wrong and why (`diagnose`), of all known `effects`
    print(diagnosis); diagnosis.extended             the cause, and the fit of the model that has it
    diagnosis.next_experiment(Limits(...), key=...)  the record that tells what this one cannot (`experiment`)

Axes, wherever a shape is given: record, individual (a candidate of the population), parameter (an unknown, initial
conditions included), generation, time (a sample), signal (an output). SI units throughout.
"""

from ehsvjax import effects, excitation, hydraulics, operators
from ehsvjax.columns import Column
from ehsvjax.comparison import Comparison, compare
from ehsvjax.diagnosis import Diagnosis, diagnose
from ehsvjax.effects import Effect
from ehsvjax.experiment import Limits, Plan, next_experiment
from ehsvjax.fit import Fit
from ehsvjax.genetic import Operators
from ehsvjax.identify import identify
from ehsvjax.inspection import Inspection
from ehsvjax.integrators import runge_kutta_4
from ehsvjax.linear import LinearModel, linearise
from ehsvjax.models import Model, Parameter, Signal, servovalve, van_der_pol
from ehsvjax.precision import Band, Bootstrap, Precision, ProfileLikelihood, cramer_rao_bound, design
from ehsvjax.record import Record
from ehsvjax.score import Score
from ehsvjax.simulate import simulate

__version__ = "0.2.0"

__all__ = [
    "Band",
    "Bootstrap",
    "Column",
    "Comparison",
    "Diagnosis",
    "Effect",
    "Fit",
    "Inspection",
    "Limits",
    "LinearModel",
    "Model",
    "Operators",
    "Parameter",
    "Plan",
    "Precision",
    "ProfileLikelihood",
    "Record",
    "Score",
    "Signal",
    "compare",
    "cramer_rao_bound",
    "design",
    "diagnose",
    "effects",
    "excitation",
    "hydraulics",
    "identify",
    "linearise",
    "next_experiment",
    "operators",
    "runge_kutta_4",
    "servovalve",
    "simulate",
    "van_der_pol",
]
