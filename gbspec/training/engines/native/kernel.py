"""Solutions and gradients of packed problems by the generated native kernel (`gbspec.backends.native`).

The kernel takes what the right-hand side uses (layers' weights, constants, initial states) and gives residuals and the
gradient of half their squares in one call; how these come from the trainable vector is left to torch, whose automatic
differentiation takes the kernel as one node (`HalfSquares`).
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gbspec.backends.module.template.networks import _folded, _layers, _torch_like
from gbspec.backends.native import CompilerError, compiled, source
from gbspec.backends.native.flat import NUMBER_WORDS, NotCoveredError
from gbspec.backends.native.source import TILE, Precision
from gbspec.data.trajectories import Array
from gbspec.diagnostics import Defect, Diagnostic, UserError
from gbspec.ir.model import Model
from gbspec.training.engines.device import device_of
from gbspec.training.engines.native.cut_steps import Placed, placed
from gbspec.training.engines.torch.doses import delivered
from gbspec.training.options import TrainOptions
from gbspec.training.problem.packing import Integers
from gbspec.training.problem.parameters import Parameters

if TYPE_CHECKING:
    from gbspec.training.problem.problem import Problem

SHARES = 8
"""Shares of the work for each thread."""
_FIELDS = (
    "t",
    "h",
    "inputs",
    "condition",
    "steps",
    "row_at",
    "row_time",
    "row_inputs",
    "measured",
    "factor",
    "value",
    "weight",
    "jump_at",
    "jump_next",
    "jump_state",
    "jump_cuts",
    "slope",
    "logarithmic",
)


class _Data(ctypes.Structure):
    """`Data` of `driver.c`."""

    _fields_ = [
        ("depth", ctypes.c_int64),
        ("trajectories", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in _FIELDS),
    ]


class Tables:
    """A problem's data as the kernel reads them, with doses that arrive at `time` [E]; keeps the arrays that its
    pointers point to. `packed`: with the sub-steps that doses of a learned lag cut."""

    def __init__(self, problem: Problem, time: Array) -> None:
        self._placed = placed(problem.packed, time)
        packed, scaling = self._placed.packed, problem.scaling
        seen = packed.weights > 0
        row_at = np.full((packed.trajectories, packed.depth + 1), -1, dtype=np.int32)
        row_at[packed.row_trajectory, packed.row_step] = np.arange(packed.rows)
        arrays = {
            # What is read step by step lies in one piece for a trajectory.
            "t": packed.t.T,
            "h": packed.h.T,
            "inputs": packed.inputs.swapaxes(0, 1),
            "condition": packed.condition,
            "steps": packed.steps,
            "row_at": row_at,
            "row_time": packed.row_time,
            "row_inputs": packed.row_inputs,
            "measured": np.where(seen, packed.values, 1.0),
            "factor": np.where(seen, packed.weights / scaling.row_scale, 0.0),
            "value": problem.forcing.value,
            "weight": problem.forcing.weight,
            "logarithmic": scaling.log.astype(np.int32),
        } | _jumps(problem.model, self._placed)
        self._kept = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        pointers = [self._kept[name].ctypes.data if name in self._kept else None for name in _FIELDS]
        self.struct = _Data(packed.depth, packed.trajectories, *pointers)
        self.packed, self.jumps = packed, len(packed.doses.time)
        self.shape = (packed.rows, len(problem.model.channels))
        self.states = len(problem.model.states)
        self.steps, self.depth = packed.steps, packed.depth
        # Trajectories of about the same number of steps share a tile.
        self.order = np.argsort(-packed.steps, kind="stable").astype(np.int64)

    @cached_property
    def jump_row(self) -> Integers:
        """The key row at the end of the stretch in which each dose arrives [E]; -1: none."""
        packed, step = self.packed, self._placed.step
        owner, wide = packed.doses.owner, packed.depth + 2
        row = np.lexsort((packed.row_step, packed.row_trajectory))
        reached = packed.row_trajectory[row] * wide + packed.row_step[row]
        place = np.searchsorted(reached, owner * wide + step, side="right")
        found = np.append(row, 0)[np.minimum(place, len(row))]
        lies = (step >= 0) & (place < len(row)) & (np.append(packed.row_trajectory[row], -1)[place] == owner)
        return np.where(lies, found, -1)


def _jumps(model: Model, places: Placed) -> dict[str, NDArray[Any]]:
    """Doses at the starts of sub-steps."""
    packed, step = places.packed, places.step
    if not len(step):
        return {}
    first = np.full((packed.trajectories, packed.depth), -1, dtype=np.int32)
    heads = np.setdiff1d(np.flatnonzero(step >= 0), places.following)
    first[packed.doses.owner[heads], step[heads]] = heads
    state = np.array([model.state_index[dose.state] for dose in model.doses], dtype=np.int32)
    return {
        "jump_at": first,
        "jump_next": places.following.astype(np.int32),
        "jump_state": state[packed.doses.kind],
        "jump_cuts": places.cuts.astype(np.int32),
        "slope": places.slope.swapaxes(0, 1),
    }


@dataclass
class Swept:
    """What a call of the kernel gives.

    `residuals` [R, C], `arrivals` [R, n_states]; gradients of weights [W], learnable constants [N, n_learnables] and
    initial states [N, n_states], doses [E] and, where lags are learned, their arrivals [E] (zeros where none were asked
    for).
    """

    residuals: Array
    arrivals: Array
    d_weights: Array
    d_constants: Array
    d_initial: Array
    d_doses: Array
    d_times: Array

    @classmethod
    def zeros(cls, tables: Tables, weights: int, learnables: int) -> Swept:
        """What is filled in for some tables."""
        n, rows = len(tables.steps), tables.shape[0]
        shapes = (tables.shape, (rows, tables.states), weights, (n, learnables), (n, tables.states))
        return cls(*(np.zeros(shape) for shape in (*shapes, tables.jumps, tables.jumps)))


class Kernel:
    """The compiled unroll of one model in one precision.

    Raises NotCoveredError for a model that it does not cover, CompilerError where it cannot be compiled.
    """

    def __init__(self, model: Model, precision: Precision = "float64") -> None:
        self.model, self.precision = model, precision
        self.library = compiled(source(model, precision))
        self.library.work_bytes.restype = ctypes.c_int64
        self.library.work_bytes.argtypes = [ctypes.c_int64]
        self.library.run.restype = None
        pointer, whole = ctypes.c_void_p, ctypes.c_int64
        self.library.run.argtypes = [pointer, pointer, *[whole] * 3, *[pointer] * 13, ctypes.c_int32, pointer]
        if precision == "float64":  # what jacobian.c adds
            self.library.stretch_bytes.restype = ctypes.c_int64
            self.library.stretch_bytes.argtypes = [ctypes.c_int64]
            self.library.stretches.restype = self.library.chain.restype = None
            self.library.stretches.argtypes = [pointer, pointer, whole, *[pointer] * 5]
            self.library.chain.argtypes = [whole, whole, *[pointer] * 9]

    def work_bytes(self, depth: int) -> int:
        """Bytes that a thread needs besides data and results, for trajectories of at most `depth` steps."""
        return int(self.library.work_bytes(depth))

    def sweep(
        self,
        tables: Tables,
        natural: Natural,
        gradient: bool,
        cotangent: Array | None = None,
        index: Integers | None = None,
        threads: int | None = None,
    ) -> Swept:
        """Solves the trajectories `index` (None: all) forward and, if `gradient`, back.

        Rows of other trajectories are zero. The gradient is
        `cotangent` [R, C] (None: the residuals) times the residuals' Jacobian.
        """
        weights, constants, initial, doses, numbers = (np.ascontiguousarray(a) for a in natural.arrays())
        order = tables.order if index is None else index[np.argsort(-tables.steps[index], kind="stable")]
        out = Swept.zeros(tables, len(weights), len(self.model.learnables))
        tiles = -(-len(order) // TILE)
        threads = max(1, min(tiles, threads if threads is not None else torch.get_num_threads()))
        # More shares than threads: a core that something else takes a while leaves its share to the others. Each share
        # has sums of its own, added in order, so that the result does not depend on which thread took which.
        count = 1 if threads == 1 else min(tiles, SHARES * threads)
        size = self.work_bytes(tables.depth)
        parts = [out.d_weights, *(np.zeros(len(weights)) for _ in range(count - 1))]
        towards = None if cotangent is None else np.ascontiguousarray(cotangent)
        given = _pointers(weights, numbers, constants, initial, doses, towards, out.residuals, out.arrivals)
        derivatives = _pointers(out.d_constants, out.d_initial, out.d_doses, out.d_times)

        def part(i: int) -> None:
            here, sums, space = (order.ctypes.data, len(order), i, count), parts[i], workspace(size)
            to = (sums.ctypes.data, *derivatives, int(gradient), space.ctypes.data)
            self.library.run(ctypes.byref(tables.struct), *here, *given, *to)

        if count == 1:
            part(0)
        else:
            _shared_out(part, count, threads)
        for other in parts[1:]:
            out.d_weights += other
        return out


def _pointers(*arrays: Array | None) -> list[int | None]:
    """Where arrays begin; None where there is none."""
    return [None if array is None else array.ctypes.data for array in arrays]


def _shared_out(part: Callable[[int], None], count: int, threads: int) -> None:
    """Does all parts on some threads. The one that asks is among them: if it slept, two that it wakes would often find
    themselves on one core. The calls hold no lock of the interpreter, so plain threads run side by side."""
    left = iter(range(count))

    def work() -> None:
        for i in left:
            part(i)

    helpers = [_pool(threads - 1, os.getpid()).submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        # Whatever stopped this one: the others read arrays of the caller.
        for _ in left:
            pass
        wait(helpers)
    for helper in helpers:
        helper.result()


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that wait for work, made anew in a forked process."""
    return ThreadPoolExecutor(threads, thread_name_prefix="gbspec-kernel")


_spaces = threading.local()


def workspace(size: int) -> NDArray[np.uint8]:
    """The work space of the thread that asks, kept between calls."""
    space: NDArray[np.uint8] | None = getattr(_spaces, "bytes", None)
    if space is None or len(space) < size:
        space = _spaces.bytes = np.empty(size, dtype=np.uint8)
    return space


_kernels: dict[tuple[type[Any], Precision], Kernel | str] = {}


def kernel_of(model: Model, module: type[Any], precision: Precision = "float64") -> Kernel | str:
    """The kernel of a model (`module` is its generated class), or in a line why there is none."""
    key = (module, precision)
    if key not in _kernels:
        try:
            _kernels[key] = Kernel(model, precision)
        except NotCoveredError as error:
            _kernels[key] = f"the native kernel does not cover this model: {error}"
        except CompilerError as error:
            _kernels[key] = str(error)
    return _kernels[key]


@dataclass(frozen=True)
class Choice:
    """What solves a problem: a kernel, or (None) the torch graph; `remark` says why it is not the kernel."""

    kernel: Kernel | None = None
    remark: str = ""


TORCH = Choice()

LEAST_SUBSTEPS = 1500
"""With fewer sub-steps in the data, `--backend auto` does not wait for the compiler: it takes two seconds or so, and at
2,500 sub-steps a fit of urp_gb2 takes 15 instead of 29."""


def choose(model: Model, module: type[Any], options: TrainOptions, substeps: int) -> Choice:
    """The choice of `--backend` for data of so many sub-steps.

    Raises UserError (GB863) where the kernel was asked for and cannot be had.
    """
    wanted = options.backend == "native"
    if options.backend == "torch" or not (wanted or substeps >= LEAST_SUBSTEPS):
        return TORCH
    if device_of(options.device) != "cpu":
        found: Kernel | str = "the native kernel does not work on a GPU"
    else:
        found = kernel_of(model, module)
    if not isinstance(found, str):
        return Choice(found)
    if wanted:
        help_text = "leave out `--backend`: the torch graph is then used"
        raise UserError([Diagnostic("GB863", f"`--backend native` is not available: {found}", None, help=help_text)])
    return Choice(None, f"the torch graph is used: {found}")


# ---------------------------------------------------------------------- from the trainable vector
def _layer_weights(problem: Problem, weights: dict[str, Tensor], like: Tensor) -> Tensor:
    """All layers' weights and biases as the kernel takes them, the networks' scales multiplied in."""
    parts: list[Tensor] = []
    for network in problem.module.networks:
        layers, scales = _layers(network, weights, problem.ops, _torch_like)
        parts += [part.reshape(-1) for layer in _folded(network, layers, scales) for part in layer]
    return torch.cat(parts) if parts else like.new_zeros(0)


def _numbers(problem: Problem, weights: dict[str, Tensor]) -> Array:
    """Centres and scales of outputs, scales of arguments, network by network."""
    names = {"center": "output_center", "scale": "output_scale", "spread": "input_scale"}
    parts = [
        weights[f"network.{network['name']}.{names[word]}"].detach().numpy().ravel()
        for network in problem.module.networks
        for word in NUMBER_WORDS
    ]
    return np.concatenate([*parts, np.zeros(0)])


@dataclass(frozen=True)
class Natural:
    """What the kernel takes, as functions of the trainable vector.

    `weights` [W], all layers as they are used; `constants` [N, n_constants]; `initial` [N, n_states]; `doses` [E], how
    much of each arrives, and `times` [E], when; `numbers`: scales that the forms of contracts use.
    """

    weights: Tensor
    constants: Tensor
    initial: Tensor
    doses: Tensor
    times: Tensor
    numbers: Array

    @classmethod
    def of(cls, problem: Problem, parameters: Parameters, vector: Tensor) -> Natural:
        """The values at a vector, differentiable in it."""
        weights = parameters.weights(vector)
        constants = parameters.constants(vector)
        condition = torch.from_numpy(problem.packed.condition)
        initial = problem.module._initial(problem.ops, parameters.starts(vector), condition, constants.unbind(1))
        layers = _layer_weights(problem, weights, vector)
        return cls(layers, constants, initial, *delivered(problem, constants), _numbers(problem, weights))

    @property
    def arrivals(self) -> Array:
        """`times` as an array."""
        return np.asarray(self.times.detach().numpy())

    def arrays(self) -> tuple[Array, ...]:
        """What a call of the kernel is given, as arrays: all but the times, which are in the tables."""
        tensors = (self.weights, self.constants, self.initial, self.doses)
        return *(x.detach().numpy() for x in tensors), self.numbers


class HalfSquares(torch.autograd.Function):
    """Half the sum of squared residuals; its gradient is found in the same call of the kernel as its value."""

    @staticmethod
    def forward(
        ctx: Any,
        call: Callable[[], Swept],
        weights: Tensor,
        constants: Tensor,
        initial: Tensor,
        doses: Tensor,
        times: Tensor,
    ) -> Tensor:
        """`call` sweeps at the values of the other arguments."""
        swept = call()
        known = constants.shape[1] - swept.d_constants.shape[1]
        d_constants = np.concatenate([np.zeros((len(constants), known)), swept.d_constants], 1)
        found = (swept.d_weights, d_constants, swept.d_initial, swept.d_doses, swept.d_times)
        ctx.save_for_backward(*map(torch.from_numpy, found))
        return weights.new_tensor(0.5 * float(np.vdot(swept.residuals, swept.residuals)))

    @staticmethod
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor | None, ...]:
        """The gradient found with the value."""
        return (None, *(scale * saved for saved in ctx.saved_tensors))


def half_squares(
    kernel: Kernel, problem: Problem, parameters: Parameters, theta: Array, index: Integers | None = None
) -> tuple[float, Array]:
    """Half the sum of squared residuals of the trajectories `index` (None: all), its gradient in the whole vector."""
    vector = torch.from_numpy(theta).requires_grad_()
    n = Natural.of(problem, parameters, vector)

    def call() -> Swept:
        return kernel.sweep(problem.tables(n.arrivals), n, True, index=index)

    loss: Tensor = HalfSquares.apply(call, n.weights, n.constants, n.initial, n.doses, n.times)  # type: ignore[no-untyped-call]  # torch's
    if not loss.requires_grad:
        return float(loss), np.zeros_like(theta)
    (gradient,) = torch.autograd.grad(loss, vector, allow_unused=True)
    return float(loss.detach()), np.zeros_like(theta) if gradient is None else gradient.numpy()


def solved(problem: Problem, parameters: Parameters, theta: Tensor) -> tuple[Array, Array, Array]:
    """Residuals [R, C], states on arrival at key rows [R, n_states] and initial states [N, n_states] at `theta`."""
    if problem.kernel is None:
        raise Defect("a problem without a kernel was to be solved by it")
    with torch.no_grad():
        natural = Natural.of(problem, parameters, theta)
    swept = problem.kernel.sweep(problem.tables(natural.arrivals), natural, False)
    return swept.residuals, swept.arrivals, natural.initial.numpy()
