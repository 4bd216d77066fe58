"""The options of training: a frozen dataclass from which flags, configuration keys and help are derived."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gbspec.diagnostics import Findings
from gbspec.given import is_real, is_whole, plain, shown
from gbspec.ir import AUTO, METHODS, RK4, STIFF, listed, unknown_method
from gbspec.training.stages import UNNAMED, Effort, StageName

if TYPE_CHECKING:
    from gbspec.runs import Option

Method = Literal["auto", "gradient-matching", "adam", "lbfgs", "lm"]
Initial = Literal["learned", "bred", "recognition"]
Device = Literal["cpu", "cuda", "auto"]
Backend = Literal["auto", "native", "torch"]
Switches = Literal["auto", "on", "off"]

STAGES = tuple(str(name) for name in StageName if name not in UNNAMED)
"""The stages that `--stages` can name; the plan determines which of them exist for a model and its data."""


@dataclass(frozen=True)
class TrainOptions:
    """The options of `gbspec train`. Each field's metadata contains its help; the defaults suit most data."""

    members: int = field(
        default=1,
        metadata={"help": "Number of fits from different seeds; their standard deviation shows the uncertainty."},
    )
    seed: int = field(default=0, metadata={"help": "Seed of the first member; member K uses SEED + K."})
    max_step: float | None = field(
        default=None,
        metadata={
            "help": "Largest step of the solver, in the unit of time; default: chosen from the data.",
            "metavar": "H",
        },
    )
    solver: str = field(
        default=AUTO,
        metadata={
            "help": f"Integration method of the solver's steps: {listed()}; `auto` is `{RK4.name}`, or "
            f"`{STIFF.name}` where the equations are stiff.",
            "metavar": "NAME",
        },
    )
    tolerance: float | None = field(
        default=None,
        metadata={
            "help": "Relative tolerance of adaptive steps, for a method with an error estimate; default: fixed steps, "
            f"except with `{STIFF.name}`, where it is chosen from the data.",
            "metavar": "RTOL",
        },
    )
    switches: Switches = field(
        default="auto",
        metadata={
            "help": "Whether steps end where right-hand sides switch (`if`, `max`, `min`, `abs`, `sign` of states): "
            "`auto` where solutions pass jumps, or the step's error shows that, and in likelihoods; `on` from the "
            "first step."
        },
    )
    method: Method = field(
        default="auto",
        metadata={
            "help": "`auto` runs all stages; `gradient-matching` only the warm start; "
            "`adam`, `lbfgs` and `lm` run one optimiser after the warm start."
        },
    )
    stages: str | None = field(
        default=None,
        metadata={
            "help": "Run only these of the stages of `auto` (separated by semicolons), whether or not the data "
            "call for them.",
            "metavar": "NAMES",
        },
    )
    effort: Effort = field(default="normal", metadata={"help": "How many iterations each stage may take."})
    start: str | None = field(
        default=None,
        metadata={
            "help": "Start from the weights and constants of an earlier run of this model, or of one with networks and "
            "constants of the same names.",
            "metavar": "RUN",
        },
    )
    epochs: int | None = field(
        default=None,
        metadata={"help": "Passes over the data for `adam`; iterations for `lbfgs` and `lm`.", "metavar": "N"},
    )
    quadrature: int | None = field(
        default=None,
        metadata={
            "help": "Nodes of adaptive Gauss-Hermite quadrature for each distributed constant of a population; 1 is "
            "Laplace's method (FOCEI). By default Laplace's, and quadrature for one or two of them where it matters.",
            "metavar": "NODES",
        },
    )
    holdout: float = field(
        default=0.0,
        metadata={
            "help": "Fraction of the trajectories (of a single one: of its last rows) that is excluded from the fit; "
            "the weights that predict them best are kept.",
            "metavar": "FRACTION",
        },
    )
    workers: int | None = field(
        default=None,
        metadata={
            "help": "Number of processes that fit members in parallel; default: one per core.",
            "metavar": "N",
        },
    )
    device: Device = field(
        default="cpu",
        metadata={"help": "Device of the solver: `cuda` is a GPU, `auto` uses a GPU if there is one."},
    )
    backend: Backend = field(
        default="auto",
        metadata={
            "help": "How the model is solved: `native` uses a C kernel compiled for the model, `torch` the torch "
            "graph; `auto` uses the kernel if there is a compiler and the data are large, or measuring both shows that "
            "it is worth its compilation."
        },
    )
    scheduler: str | None = field(
        default=None,
        metadata={
            "help": "Address of a dask scheduler whose workers fit the members: tcp://HOST:PORT.",
            "metavar": "ADDRESS",
        },
    )
    resume: bool = field(default=False, metadata={"help": "Continue an interrupted run where it stopped."})
    forcing: str = field(
        default="teacher",
        metadata={
            "help": "`teacher`: states are reset to their measured values at each row; `autoregressive`: never; "
            "a number between 0 and 1: in part (1 is teacher).",
            "metavar": "teacher|autoregressive|BLEND",
        },
    )
    initial: Initial = field(
        default="learned",
        metadata={
            "help": "Initial states that are neither measured nor given by the model: `learned`; `bred`, that is, "
            "finally brought onto the slow manifold by the dynamics; or learned, with a `recognition` network that "
            "estimates those of new trajectories from their first measurements.",
        },
    )
    random_substeps: bool = field(
        default=False,
        metadata={"help": "Draw the solver's steps at random, so that the error of a fixed step is not learned."},
    )
    batch_size: int = field(default=32, metadata={"help": "Trajectories in a minibatch of `adam`."})
    learning_rate: float = field(default=3e-3, metadata={"help": "Peak learning rate of `adam` (one-cycle schedule)."})
    warm_start: bool = field(
        default=True, metadata={"help": "Start from gradient matching on splines; otherwise from random weights."}
    )
    output_scale: float = field(
        default=1.0,
        metadata={
            "help": "Factor on the scale of the networks' outputs, which is derived from the slopes of the data; "
            "with a large factor the fit can become dependent on the step.",
            "metavar": "FACTOR",
        },
    )
    half_step: bool = field(
        default=True, metadata={"help": "Continue at half the step at the end (only with `--method auto`)."}
    )
    ridge: float | None = field(
        default=None,
        metadata={
            "help": "Standard deviation of the weights' prior, relative to their initial size; "
            "default: chosen from the data; 0 for no prior.",
            "metavar": "SD",
        },
    )
    threads: int | None = field(
        default=None,
        metadata={
            "help": "Threads of each worker; default: number of cores divided by number of workers (1 on a cluster).",
            "metavar": "N",
        },
    )

    def __post_init__(self) -> None:
        for name in ("max_step", "learning_rate", "output_scale", "holdout", "ridge", "tolerance"):
            object.__setattr__(self, name, plain(getattr(self, name)))

    @property
    def blend(self) -> float:
        """Strength of teacher forcing: 1 for `teacher`, 0 for `autoregressive`."""
        return {"teacher": 1.0, "autoregressive": 0.0}.get(self.forcing) or _number(self.forcing) or 0.0

    @property
    def named_stages(self) -> tuple[str, ...]:
        """The stages given by name; hyphens may replace blanks, and commas may be left out."""
        known = {stage.replace(",", ""): stage for stage in STAGES}
        parts = re.sub("[-_,]", " ", str(self.stages or "")).lower().split(";")
        names = [" ".join(part.split()) for part in parts]
        return tuple(known.get(name, name) for name in names if name)

    def check(self, findings: Findings) -> None:
        """Reports every option with an invalid value (GB850)."""

        def report(flag: str, value: object, expected: str) -> None:
            findings.error("GB850", f"`--{flag} {value}` must be {expected}", None, subject=flag)

        for name, low in (
            ("members", 1),
            ("seed", 0),
            ("workers", 1),
            ("batch_size", 1),
            ("epochs", 1),
            ("threads", 1),
            ("quadrature", 1),
        ):
            value = getattr(self, name)
            if not self._left_out(name) and not (is_whole(value) and value >= low):
                report(name.replace("_", "-"), shown(value), f"a whole number of at least {low}")
        for name in ("max_step", "learning_rate", "output_scale"):
            value = getattr(self, name)
            if not self._left_out(name) and not (is_real(value) and 0 < value < float("inf")):
                report(name.replace("_", "-"), shown(value), "a positive number")
        if self.scheduler is not None and not all(self.scheduler.partition("://")):
            report("scheduler", self.scheduler, "an address such as tcp://host:8786")
        if not (is_real(self.holdout) and 0 <= self.holdout < 1):
            report("holdout", shown(self.holdout), "at least 0 and below 1")
        if self.ridge is not None and not (is_real(self.ridge) and 0 <= self.ridge < float("inf")):
            report("ridge", shown(self.ridge), "a non-negative number")
        for name in self.named_stages or ([self.stages] if self.stages is not None else []):
            if name not in STAGES:
                report("stages", name, "one of " + ", ".join(f"`{stage}`" for stage in STAGES))
        if self.stages is not None and self.method != "auto":
            report("method", self.method, "`auto` where stages are named")
        number = _number(self.forcing)
        if self.forcing not in ("teacher", "autoregressive") and (number is None or not 0 <= number <= 1):
            report("forcing", self.forcing, "`teacher`, `autoregressive`, or a number from 0 to 1")
        if self.solver not in METHODS and self.solver != AUTO:
            findings.add(unknown_method(self.solver))
        if self.tolerance is not None:
            known = METHODS.get(self.solver)
            if not (is_real(self.tolerance) and 0 < self.tolerance < 1):
                report("tolerance", shown(self.tolerance), "above 0 and below 1")
            elif known is not None and known.b_error is None:
                reason = f"left out with `--solver {self.solver}`, which has no error estimate"
                report("tolerance", self.tolerance, reason)
        chosen = {"method": Method, "effort": Effort, "initial": Initial, "device": Device, "backend": Backend}
        chosen["switches"] = Switches
        for name, allowed in chosen.items():
            if getattr(self, name) not in allowed.__args__:  # type: ignore[attr-defined]  # literal types list their values there
                report(name, getattr(self, name), "one of " + ", ".join(allowed.__args__))  # type: ignore[attr-defined]  # as above

    def _left_out(self, name: str) -> bool:
        """Whether an option that may be None is."""
        return getattr(self, name) is None and getattr(type(self), name) is None

    def to_json(self) -> dict[str, str | int | float | bool | None]:
        """All options by name, as stored in `fit.json`, except those that belong to a call and not to a run."""
        named = {"stages": "; ".join(self.named_stages) or None}
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("resume", "scheduler")} | named

    def settings(self, left_out: Collection[str]) -> dict[str, str | int | float | bool | None]:
        """The options that a result depends on, for a fingerprint, without those in `left_out`.

        Options that earlier versions did not have are omitted at their defaults, so that fingerprints stay valid.
        """
        usual = {"solver": AUTO, "tolerance": None, "quadrature": None, "start": None, "switches": "auto"}
        kept = {name: value for name, value in self.to_json().items() if name not in left_out}
        return {name: value for name, value in kept.items() if name not in usual or value != usual[name]}

    @classmethod
    def recorded(cls, options: Mapping[str, Option], run: Path) -> TrainOptions:
        """The options of a run recorded in its `fit.json`; missing ones have their defaults.

        Raises UserError (GB852) if an option has an invalid value.
        """
        from gbspec.runs import DAMAGED, JsonError, decode, files

        findings = Findings()
        try:
            found = decode(cls, options, "options")
            found.check(findings)
        except JsonError as error:
            for finding in error.findings:
                findings.error("GB852", f"`{run / files.FIT}` is damaged: {finding}", None, help=DAMAGED)
        findings.raise_if_failed()
        return found


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
