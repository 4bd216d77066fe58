"""Solutions and derivatives of packed problems by the compiled native kernel of a model (`gbspec.backends.native`)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.backends import CompilerError, GeneratedModule, Library, NotCoveredError, Precision, Struct, source
from gbspec.ir import METHODS, RK4, Method, Model
from gbspec.training.engines.engine import Lack, Unable
from gbspec.training.engines.native.inputs import KernelInputs
from gbspec.training.engines.native.searches import source_with, with_searches
from gbspec.training.engines.native.tables import Tables
from gbspec.training.engines.native.threads import shared_out, workspace
from gbspec.training.problem import Integers

Counts = NDArray[np.int32]

SHARES = 8
"""Number of shares of the work per thread."""


@dataclass
class Swept:
    """The results of a call of the kernel.

    `residuals` [R, C], `states` at the key rows before resets [R, n_states]; gradients by weights [W], learnable
    constants [N, n_learnables], initial states [N, n_states], amounts of doses [E] and, if lags are learned, their
    times of arrival [E], times of delays [N, n_lags] (zeros if no gradient was requested). `late` [R, n_delays]:
    delayed values at the key rows; `happened` [N, events]: how often each event happens; `endless` [N]: whether events
    follow each other without end; `uncut` [N]: sub-steps that could not be cut where right-hand sides switch.
    """

    residuals: Array
    states: Array
    d_weights: Array
    d_constants: Array
    d_initial: Array
    d_amounts: Array
    d_times: Array
    d_lags: Array
    late: Array
    happened: Counts = field(init=False)
    endless: Counts = field(init=False)
    uncut: Counts = field(init=False)

    @classmethod
    def zeros(cls, tables: Tables, weights: int, sizes: dict[str, int]) -> Swept:
        """Results of zeros, to be filled by a call for some tables."""
        n, rows = len(tables.steps), tables.shape[0]
        shapes = (tables.shape, (rows, tables.states), weights, (n, sizes["LEARNABLES"]), (n, tables.states))
        of_delays = ((n, sizes["LAGS"]), (rows, sizes["DELAYS"]))
        found = cls(*(np.zeros(shape) for shape in (*shapes, tables.arrivals, tables.arrivals, *of_delays)))
        found.happened = np.zeros((n, sizes["EVENTS"]), dtype=np.int32)
        found.endless, found.uncut = (np.zeros(n, dtype=np.int32) for _ in range(2))
        return found

    def filled_by(self, library: Library) -> Struct:
        """The kernel's argument: the arrays into which all shares of a call write."""
        arrays = {name: value for name, value in vars(self).items() if name != "d_weights"}
        return library.struct("Outputs", **arrays)


class Kernel:
    """The compiled solver of one model with one method in one precision.

    `blocks`: as for `gbspec.backends.source`. `plans`: it can choose adaptive steps. Raises NotCoveredError for a model
    that it does not cover, CompilerError if it cannot be compiled.
    """

    def __init__(self, model: Model, precision: Precision = "float64", method: Method = RK4, blocks: int = 1) -> None:
        self.model, self.precision = model, precision
        plain, searches = with_searches(model)
        self.library = Library(source_with(source(plain, precision, method, blocks), model, searches))
        self.plans = precision == "float64" and method.b_error is not None
        self.plans = self.plans and not model.delays and blocks == 1

    def work_bytes(self, depth: int) -> int:
        """Bytes that a thread needs besides data and results, for trajectories of at most `depth` steps."""
        return self.library.work_bytes(depth)

    def sweep(
        self,
        tables: Tables,
        inputs: KernelInputs,
        gradient: bool,
        cotangent: Array | None = None,
        index: Integers | None = None,
        threads: int | None = None,
    ) -> Swept:
        """Solves the trajectories `index` (None: all) forward and, if `gradient`, backward.

        Rows of other trajectories are zero. The gradient is `cotangent` [R, C] (None: the residuals) times the
        residuals' Jacobian.
        """
        order = tables.order if index is None else index[np.argsort(-tables.steps[index], kind="stable")]
        out = Swept.zeros(tables, len(inputs.weights), self.library.sizes)
        tiles = -(-len(order) // self.library.sizes["TILE"])
        threads = max(1, min(tiles, threads if threads is not None else torch.get_num_threads()))
        # More shares than threads, so that a thread that is held up leaves work to the others. Each share has its own
        # sums, which are added in order, so that the result does not depend on which thread processed which share.
        count = 1 if threads == 1 else min(tiles, SHARES * threads)
        size, library = self.work_bytes(tables.depth), self.library
        parts = [out.d_weights, *(np.zeros_like(out.d_weights) for _ in range(count - 1))]
        data, given, filled = tables.data(library), inputs.struct(library), out.filled_by(library)
        common: dict[str, Array | Integers | int | None] = {
            "count": len(order),
            "stride": count,
            "gradient": int(gradient),
            "order": order,
            "cotangent": None if cotangent is None else np.ascontiguousarray(cotangent),
        }

        def part(i: int) -> None:
            share = library.struct("Share", first=i, d_weights=parts[i], **common)
            library.run(data, given, share, filled, workspace(size))

        if count == 1:
            part(0)
        else:
            shared_out(part, count, threads)
        for other in parts[1:]:
            out.d_weights += other
        return out


_kernels: dict[tuple[type[GeneratedModule], Precision, int], Kernel | Unable] = {}


def kernel_of(
    model: Model, module: type[GeneratedModule], precision: Precision = "float64", blocks: int = 1
) -> Kernel | Unable:
    """The kernel of a model (`module` is its generated class; `blocks` as for `Kernel`), or why there is none."""
    key = (module, precision, blocks)
    if key not in _kernels:
        try:
            _kernels[key] = Kernel(model, precision, METHODS[module.solver], blocks)
        except NotCoveredError as error:
            _kernels[key] = Unable(Lack.MODEL, f"the native kernel does not cover this model: {error}")
        except CompilerError as error:
            _kernels[key] = Unable(Lack.COMPILER, str(error))
    return _kernels[key]
