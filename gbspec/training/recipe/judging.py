"""What the data and the present vector say: noise, and whether whole solutions follow the data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Model
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.problem import Parameters, mean_loss, typical
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.planned import Reached, shortened, step_fraction
from gbspec.training.recipe.weighing import noise_table
from gbspec.training.stages import StageName
from gbspec.training.starts import refit_starts

NOISE = 0.01
"""Above this typical residual of a channel after teacher forcing (in standard deviations) the data are treated as
noisy; above this root mean square of a channel's residual whole solutions do not follow the data."""
ASTRAY = 0.3
"""Above this root mean square of a channel's residual (R² of 0.91) whole solutions have to be found from segments."""
LOST = 1.0
"""Above it (R² below 0) they tell nothing."""
FEW = 600
"""Below this number of measured values the weights have a prior from the first iteration."""


def unmeasured(model: Model) -> bool:
    """Whether a state is not measured by a channel of its own: measured values then tell little of its rates."""
    return not set(range(len(model.states))) <= {channel.state for channel in model.channels}


def channel_errors(engine: Engine, theta: Array) -> Array:
    """The root mean square residual of each channel [C] at a vector; infinite where one is not finite."""
    table, seen = noise_table(engine, theta), engine.problem.seen
    return np.array([np.sqrt(2 * mean_loss(table[seen[:, i], i])) for i in range(table.shape[1])])


@dataclass(frozen=True)
class Judged:
    """Decisions for a context by what has been reached; `parameters` is the layout of the vector of intervals,
    `released` that of whole solutions, `values` the number of measured values."""

    context: Context
    parameters: Parameters
    released: Parameters
    values: int

    def noise(self, reached: Reached) -> float:
        """The typical residual of intervals."""
        return typical(residual_vector(self._intervals(reached), reached.theta))

    def noisy(self, reached: Reached) -> bool:
        """Whether a channel's typical residual of intervals exceeds `NOISE`."""
        engine = self._intervals(reached)
        table, seen = noise_table(engine, reached.theta), engine.problem.seen
        return any(typical(table[seen[:, i], i]) > NOISE for i in range(table.shape[1]))

    def _intervals(self, reached: Reached) -> Engine:
        return self.context.engine(self.parameters, 1.0, shortened(reached.begun))

    def noisy_whole(self, reached: Reached) -> bool:
        """Whether whole solutions were fitted to data that are not exact."""
        return StageName.AUTOREGRESSIVE in reached.marks and self.noisy(reached)

    def whole_error(self, reached: Reached, *, refitted: bool = False) -> float:
        """The root mean square residual of whole solutions, of the channel in which it is largest; `refitted`: from
        initial states that are fitted to the first rows of whole solutions."""
        engine = self.context.engine(self.released, 0.0, step_fraction(reached.begun))
        theta = refit_starts(engine, reached.theta, self.context.seed) if refitted else reached.theta
        return float(channel_errors(engine, theta).max(initial=0.0))

    def astray(self, reached: Reached) -> bool:
        """Whether whole solutions are so far from the data that segments are needed to find them.

        Not where all states are measured and other initial states bring them back: noisy first values, and a few starts
        that teacher forcing left far off, say nothing against the dynamics. Not with few noisy values either: segments
        are fitted without a ridge, and would follow the noise. Yet they are all that is left where intervals could not
        be fitted, or where whole solutions are worse than the mean.
        """
        if StageName.TEACHER not in reached.marks:
            return True
        error = self.whole_error(reached)
        if error > ASTRAY and not unmeasured(self.context.model):
            error = min(error, self.whole_error(reached, refitted=True))
        return error > LOST or (error > ASTRAY and (self.values >= FEW or not self.noisy(reached)))

    def whole_astray(self, reached: Reached) -> bool:
        """Whether whole solutions are far from the data."""
        return self.whole_error(reached) > ASTRAY

    def unfollowed(self, reached: Reached) -> bool:
        """Whether whole solutions have to be fitted: they do not follow the data, or the data are noisy."""
        return StageName.HORIZONS in reached.marks or self.noisy(reached) or self.whole_error(reached) > NOISE

    def exact(self, reached: Reached) -> bool:
        """Whether neither intervals nor whole solutions show any noise."""
        return not self.noisy(reached) and self.whole_error(reached) <= NOISE
