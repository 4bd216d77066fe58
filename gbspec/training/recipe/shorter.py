"""A shorter step for whole solutions that the step itself makes blow up.

An explicit step is chosen for the constants of the warm start. Fits of intervals may move constants to where it is not
stable: between two rows, at which measured states are set again, such errors hardly grow, and a state that nothing
measures may even be made to follow the data by them. Whole solutions blow up there. They are no longer those of the
equations, and a fit of them would not begin.
"""

from __future__ import annotations

from gbspec.arrays import Array
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.optimise import Outcome, Stage, State
from gbspec.training.problem import Parameters, mean_loss
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.finer import NETWORK_HALVINGS, astray
from gbspec.training.recipe.planned import Decision, Planned, Reached, shortened
from gbspec.training.stages import Effort, StageName


class ShorterStep:
    """The stage that goes on with the step of `engine`, and shows it; the vector stays as it is."""

    name, total = StageName.SHORTER.value, 1

    def __init__(self, engine: Engine, remark: str) -> None:
        self.engine, self.remark = engine, remark

    def begin(self, theta: Array) -> State:
        """The state of the stage: only the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """The loss at the shorter step."""
        loss = mean_loss(residual_vector(self.engine, state["theta"]))
        return Outcome(state, loss, True, remark=self.remark)


def shorter_steps(
    context: Context, layout: Parameters, blend: float, wanted: Decision, effort: Effort
) -> list[Planned]:
    """Halve the step for the stages that follow, as often as is needed, if solutions with teacher forcing of strength
    `blend` blow up or are far from the data at the present step, and are not at a shorter one. Not where the step is
    the user's, or adaptive. `wanted` is the decision of the stage that needs such solutions.
    """
    most = NETWORK_HALVINGS[effort]

    def lost(reached: Reached, halvings: int) -> bool:
        return bool(astray(context.engine(layout, blend, 0.5**halvings), reached.theta).any())

    def possible(reached: Reached) -> bool:
        if context.adaptive or context.options.max_step is not None:
            return False
        taken = list(reached.begun).count(StageName.SHORTER)
        return taken < most and lost(reached, taken) and not all(lost(reached, n) for n in range(taken + 1, most + 1))

    def make(reached: Reached) -> Stage:
        fraction = shortened(reached.begun) / 2
        said = f"largest step {fraction * context.max_step:.3g}, since solutions with twice this step blew up"
        return ShorterStep(context.engine(layout, blend, fraction), f"{said} or were far from the data")

    return [Planned(StageName.SHORTER, 1, make, wanted, possible) for _ in range(most)]
