"""All variants of the training step, and the check that they agree, which precedes all timings."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from benchmarks.harness import pinned
from benchmarks.workload import Array, Workload
from gbspec.training.engines.objective import objective

Dtype = Literal["float32", "float64"]

TOLERANCE = {"float64": 1e-9, "float32": 1e-3}
"""Largest distance of a gradient from the reference, relative to its norm."""

STEPS_TOLERANCE = 1e-4
"""The same for libraries that take other steps, or use another method of the same order."""


@dataclass(frozen=True)
class Variant:
    """An implementation of the step: the module and function that build it, and its differences.

    `same_steps` is False if its steps are not those of the workload; `forcing` is "AR" if it cannot reset states to
    measured values.
    """

    title: str
    module: str
    function: str
    dtypes: tuple[Dtype, ...] = ("float32", "float64")
    forcing: Literal["TF", "AR"] = "TF"
    same_steps: bool = True
    threads: int = 1

    def build(self, work: Workload, dtype: Dtype) -> Callable[[], Any]:
        """The step as a call without arguments; raises ImportError if the library is missing."""
        library = importlib.import_module(self.module)
        kind = library.jnp.dtype(dtype) if "jax" in vars(library) else getattr(torch, dtype)
        return getattr(library, self.function)(work if self.forcing == "TF" else work.autoregressive(), kind)


PEERS = "benchmarks.peers."

VARIANTS: Mapping[str, Variant] = {
    "native": Variant("**gbspec, native kernel**", "benchmarks.own", "native"),
    "native-2": Variant("**gbspec, native kernel, two cores**", "benchmarks.own", "native_2", threads=2),
    "numba": Variant("loops by hand, compiled by numba", PEERS + "numba_loops", "kernel"),
    "graph": Variant("gbspec, torch graph", "benchmarks.own", "graph"),
    "jax-checkpoint": Variant("JAX `lax.scan` with `jax.checkpoint`", PEERS + "jax_scan", "checkpointed"),
    "jax": Variant("JAX `lax.scan`", PEERS + "jax_scan", "plain"),
    "torch": Variant("torch eager, written well", PEERS + "torch_eager", "well_written"),
    "torch-naive": Variant("torch eager, naive, packed", PEERS + "torch_eager", "naive"),
    "torch-aligned": Variant(
        "torch eager, naive, all trajectories wait for the longest interval", PEERS + "torch_eager", "aligned"
    ),
    "torchdiffeq-packed": Variant(
        "torchdiffeq `rk4`, one `odeint` per packed step", PEERS + "torchdiffeq_rk4", "packed_step", same_steps=False
    ),
    "torchdiffeq": Variant(
        "torchdiffeq `rk4`, one `odeint` per interval",
        PEERS + "torchdiffeq_rk4",
        "interval",
        same_steps=False,
    ),
    "diffrax": Variant("diffrax, one solve, AR", PEERS + "diffrax_solve", "one_solve", forcing="AR"),
    "diffrax-scan": Variant("diffrax, scan with one solve per interval", PEERS + "diffrax_solve", "scan_of_solves"),
}


@dataclass(frozen=True)
class Candidate:
    """A variant built for a workload in one precision; `run` is timed."""

    name: str
    dtype: Dtype
    run: Callable[[], Any]

    @property
    def variant(self) -> Variant:
        """What it is."""
        return VARIANTS[self.name]

    @property
    def label(self) -> str:
        """Name and precision, the key of its results."""
        return f"{self.name} {self.dtype}"

    def gradient(self, work: Workload) -> tuple[float, Array]:
        """Loss, and the gradient with respect to natural values, of one run."""
        return natural(self.name, work, self.run())


def natural(name: str, work: Workload, result: Any) -> tuple[float, Array]:
    """Loss and gradient of a variant's result, in float64, with respect to natural values in the workload's order."""
    loss, gradient = result
    if VARIANTS[name].module == "benchmarks.own":
        return float(loss), work.natural(np.asarray(gradient, dtype=np.float64))
    if isinstance(gradient, dict):
        from benchmarks.peers.jax_scan import parts

        gradient = parts(gradient)
    for part in gradient:
        wanted = str(part.dtype).removeprefix("torch.")
        if wanted != str(gradient[0].dtype).removeprefix("torch."):
            raise AssertionError(f"{name} mixes {wanted} with other types")
    return float(loss), work.flat(gradient)


def reference(work: Workload) -> tuple[float, Array]:
    """Loss and gradient by the generated module's torch graph in float64."""
    loss, gradient = objective(work.problem, work.parameters, "torch")(work.theta)
    return loss, work.natural(gradient)


class DisagreementError(AssertionError):
    """Two variants do not compute the same."""


def build(
    work: Workload, names: Iterable[str], dtypes: Iterable[Dtype], say: Callable[[str], None] = lambda text: None
) -> list[Candidate]:
    """Builds variants; those whose library is missing are skipped, with a message."""
    prepare_jax()
    made = []
    for name in names:
        variant = VARIANTS[name]
        try:
            with pinned(variant.threads):
                made += [Candidate(name, d, variant.build(work, d)) for d in dtypes if d in variant.dtypes]
        except ImportError as error:
            say(f"{name}: skipped: {error} (`pip install .[benchmarks]` installs the peers)")
    return made


def agree(work: Workload, candidates: Iterable[Candidate], say: Callable[[str], None] = lambda text: None) -> None:
    """Compares each with the reference; raises DisagreementError if a loss or gradient differs."""
    references: dict[str, tuple[float, Array]] = {}
    for candidate in candidates:
        forcing = candidate.variant.forcing
        if forcing not in references:
            references[forcing] = reference(work if forcing == "TF" else work.autoregressive())
        with pinned(candidate.variant.threads):
            found = candidate.gradient(work)
        error = compare(candidate, found, references[forcing])
        say(f"{candidate.label}: gradient within {error:.1e} of the reference")


def compare(candidate: Candidate, found: tuple[float, Array], expected: tuple[float, Array]) -> float:
    """The larger of the relative errors of loss and gradient; raises DisagreementError if it is too large."""
    loss, gradient = found
    error = max(
        abs(loss - expected[0]) / abs(expected[0]),
        float(np.linalg.norm(gradient - expected[1]) / np.linalg.norm(expected[1])),
    )
    allowed = max(TOLERANCE[candidate.dtype], 0.0 if candidate.variant.same_steps else STEPS_TOLERANCE)
    if not error <= allowed:
        raise DisagreementError(f"{candidate.label} is {error:.1e} away from the reference (allowed: {allowed:.0e})")
    return error


def prepare_jax() -> None:
    """Restricts XLA to one thread and enables float64; does nothing if jax is not installed."""
    import os

    flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ.setdefault("XLA_FLAGS", flags)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    try:
        import jax
    except ImportError:
        return
    jax.config.update("jax_enable_x64", True)
    with pinned(1):
        jax.devices()
