"""gbspec's own training step, by the functions that `gbspec train` calls."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch

from benchmarks.workload import Array, Workload
from gbspec.training.engines.native import threads as kernel_threads
from gbspec.training.engines.objective import objective

Step = Callable[[], tuple[float, Array]]


def precision_of(dtype: torch.dtype) -> Literal["float64", "float32"]:
    """The name of a torch type."""
    return "float64" if dtype == torch.float64 else "float32"


def graph(work: Workload, dtype: torch.dtype) -> Step:
    """The generated module unrolled as a torch graph."""
    function = objective(work.problem, work.parameters, "torch", precision_of(dtype))
    return lambda: function(work.theta)


def native(work: Workload, dtype: torch.dtype, threads: int = 1) -> Step:
    """The generated native kernel. Raises ImportError if it is not available."""
    try:
        function = objective(work.problem, work.parameters, "native", precision_of(dtype))
    except ValueError as error:
        raise ImportError(str(error)) from None

    def run() -> tuple[float, Array]:
        torch.set_num_threads(threads)
        try:
            return function(work.theta)
        finally:
            torch.set_num_threads(1)

    return run


def release() -> None:
    """Frees the work space that is kept between steps, so that the next step allocates all that it needs."""
    kernel_threads.release()


native_2 = partial(native, threads=2)
