"""The options of large commands by subject, most used first: how the help shows them.

A group is a panel of the help; the first has no title and stands with a command's own options. Options that are not
named here follow in the first group.
"""

from __future__ import annotations

FIRST = ""
"""The group of the options that are used most."""

GROUPS: dict[str, dict[str, tuple[str, ...]]] = {
    "TrainOptions": {
        FIRST: ("members", "effort", "seed", "holdout", "resume"),
        "Solver": ("max_step", "solver", "tolerance", "switches", "random_substeps"),
        "Where it runs": ("workers", "threads", "device", "backend", "scheduler"),
        "Stages": ("start", "initial", "forcing", "stages", "method", "warm_start", "half_step"),
        "Details of the fit": ("ridge", "quadrature", "output_scale", "epochs", "batch_size", "learning_rate"),
    },
    "SimulateOptions": {
        FIRST: ("trajectories", "span", "dt", "noise", "seed"),
        "Starts, conditions and doses": ("initial", "condition", "dose", "reject"),
        "What is measured, and when": ("sampling", "channels", "clock", "keep_start"),
    },
    "StudyOptions": {
        FIRST: ("case", "members", "effort", "noise", "seed"),
        "Where it runs": ("workers", "threads"),
        "What is kept": ("keep_runs", "table_only"),
    },
}
"""Fields by group, in the order of the help, for each dataclass of options."""


def group_of(options: str, name: str) -> str:
    """The group of an option of a dataclass."""
    return next((group for group, names in GROUPS.get(options, {}).items() if name in names), FIRST)


def place(options: str, name: str) -> int:
    """The place of an option among all of its dataclass; those that are not named here come last."""
    names = [name for group in GROUPS.get(options, {}).values() for name in group]
    return names.index(name) if name in names else len(names)
