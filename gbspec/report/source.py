"""The source of a run's figures: the run, its data, and the requested trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from gbspec.data import evenly_spaced
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.report.collect import Fitted

if TYPE_CHECKING:
    from gbspec.analysis import Eigen
    from gbspec.data import Trajectories
    from gbspec.report.content import LearnedFunction
    from gbspec.runs import Run


class MissingError(Exception):
    """The run, the model or the data lack the content of a figure: `why`, and which figure can be drawn `instead`."""

    def __init__(self, why: str, instead: str) -> None:
        super().__init__(why)
        self.why, self.instead = why, instead


@dataclass(frozen=True)
class Source:
    """A run, its `data` (None if not available), and labels of trajectories to `show` (none: some of them).

    `page`: the figure is for the page, which has room for more than a file. `over` and `spectra` are the run over its
    data and the eigenvalues along them, if they have been computed already.
    """

    run: Run
    data: Trajectories | None
    show: tuple[str, ...] = ()
    page: bool = False
    over: Fitted | None = None
    spectra: Eigen | None = None

    @cached_property
    def fitted(self) -> Fitted:
        """The run applied to its data. Raises `MissingError` if there are none."""
        if self.over is not None:
            return self.over
        if self.data is None or not len(self.data):
            raise MissingError(
                "the table that the run was trained on was not found; give its path with `--data`", "constants"
            )
        return Fitted(self.run, self.data)

    @cached_property
    def functions(self) -> tuple[LearnedFunction, ...]:
        """The learned functions over the data."""
        from gbspec.report.unknowns import learned_functions

        return learned_functions(self.fitted)

    def chosen(self) -> list[int]:
        """The requested trajectories, in that order. Raises `UserError` (GB813) if one does not exist."""
        labels = [item.label for item in self.fitted.data.items]
        missing = [label for label in self.show if label not in labels]
        if missing:
            named = ", ".join(f"`{label}`" for label in missing)
            help = f"the first ones are {', '.join(labels[:8])}"
            raise UserError([Diagnostic("GB813", f"the table has no trajectory {named}", None, help=help)])
        return [labels.index(label) for label in self.show]

    def some(self, in_file: int, on_page: int) -> list[int]:
        """The requested trajectories; by default the first few in a file, and evenly selected ones on the page."""
        count = len(self.fitted.data)
        return self.chosen() or (evenly_spaced(count, on_page) if self.page else list(range(min(in_file, count))))
