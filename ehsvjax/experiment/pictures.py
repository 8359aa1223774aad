"""A plan as a picture."""

from typing import TYPE_CHECKING

from ehsvjax import plots

if TYPE_CHECKING:
    import matplotlib.figure

    from ehsvjax.experiment.plan import Plan


def plot_plan(plan: "Plan") -> "matplotlib.figure.Figure":
    """Draw the inputs, what each explanation says of each output, and where they part; records beside each other."""
    model = next(iter(plan.explanations.values())).model
    said = {name: plan.predicted(name) for name in plan.explanations}
    return plots.plot_experiment(plan.records, model, said, plan.chosen.outputs)
