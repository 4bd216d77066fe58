"""The choice of the engine that solves a problem; engines are chosen only here.

With few data `gbspec.training.runs.backend` measures beforehand which one is faster, and asks for it by name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from gbspec.backends import GeneratedModule
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import Model
from gbspec.training.engines.device import device_of
from gbspec.training.engines.engine import Engine, Lack, Unable
from gbspec.training.engines.native import Kernel, NativeEngine, kernel_of
from gbspec.training.engines.torch import TorchEngine
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Parameters, Problem

LEAST_SUBSTEPS = 1500
"""With fewer sub-steps in the data, `--backend auto` compiles the kernel only if measurements show that it is worth the
two to three seconds; at 2,500 sub-steps the kernel reduces the time of a fit of urp_gb2 from 29 s to 15 s."""


@dataclass(frozen=True)
class Choice:
    """The engine of a fit: with a kernel the native engine, else the torch graph on `device`; `unable` gives the reason
    if the native engine was considered but cannot be used."""

    kernel: Kernel | None = None
    device: str = "cpu"
    batch: int | None = None
    unable: Unable | None = None

    @property
    def remark(self) -> str:
        """A remark on the choice for the user; empty if the choice is the expected one."""
        return f"the torch graph is used: {self.unable.reason}" if self.unable is not None else ""

    def of_model(self, model: Model, module: type[GeneratedModule], blocks: int = 1) -> Choice:
        """The same choice for another model, with its own kernel where this one has one; `blocks` as for `Kernel`."""
        if self.kernel is None:
            return self
        found = kernel_of(model, module, blocks=blocks)
        return replace(self, kernel=found if isinstance(found, Kernel) else None)

    def engine(self, problem: Problem, parameters: Parameters) -> Engine:
        """The engine of a problem."""
        own = self.kernel is None or len(self.kernel.model.switches) == len(problem.model.switches)
        kernel = self.kernel if own else self.of_model(problem.model, type(problem.module)).kernel
        if kernel is not None:
            return NativeEngine(problem, parameters, kernel)
        return TorchEngine(problem, parameters, self.device, batch=self.batch)


def few(model: Model, options: TrainOptions, substeps: int) -> bool:
    """Whether a kernel is not worth its compilation by the number of sub-steps alone."""
    # A search for the best minimum solves the model thousands of times, however few the data are; so do a likelihood
    # of learned noises and the pooled fits before it, and all the more the inner problems of a population.
    often = (model.complete and options.method == "auto") or model.marginal
    return substeps < LEAST_SUBSTEPS and not often


def choose(
    model: Model, module: type[GeneratedModule], options: TrainOptions, substeps: int, worthwhile: bool = False
) -> Choice:
    """The choice according to `--backend` for data with `substeps` sub-steps; `module` is the model's generated class.

    `worthwhile`: a kernel is worth its compilation however few the sub-steps are.

    Raises UserError (GB863) if the kernel was requested and is not available.
    """
    device, wanted = device_of(options.device), options.backend == "native"
    if options.backend == "torch" or not (wanted or worthwhile or not few(model, options, substeps)):
        return Choice(None, device, options.batch_size)
    if device != "cpu":
        found: Kernel | Unable = Unable(Lack.DEVICE, "the native kernel does not work on a GPU")
    else:
        found = kernel_of(model, module)
    if isinstance(found, Kernel):
        return Choice(found)
    if wanted:
        help_text = "leave out `--backend`: the torch graph is then used"
        raise UserError(
            [Diagnostic("GB863", f"`--backend native` is not available: {found.reason}", None, help=help_text)]
        )
    return Choice(None, device, options.batch_size, found)


def native_engine(
    problem: Problem, parameters: Parameters, precision: Literal["float64", "float32"] = "float64"
) -> NativeEngine:
    """The native engine of a problem. Raises ValueError if it is not available."""
    kernel = kernel_of(problem.model, type(problem.module), precision)
    if isinstance(kernel, Unable):
        raise ValueError(kernel.reason)
    return NativeEngine(problem, parameters, kernel)


def torch_engine(
    problem: Problem,
    parameters: Parameters,
    device: str = "cpu",
    precision: Literal["float64", "float32"] = "float64",
    batch: int | None = None,
) -> TorchEngine:
    """The torch engine of a problem."""
    return TorchEngine(problem, parameters, device, precision, batch)
