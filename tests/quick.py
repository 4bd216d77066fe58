"""Whole fits and comparisons made short, as contexts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

FLAGS = ["-std=gnu11", "-Og", "-Dalways_inline=unused", "-shared", "-fPIC"]
"""Compilation takes a fifth of the time with few optimisations and functions that are not inlined (0.35 s instead of
1.8 s). Without any it takes 0.1 s less, but networks are then evaluated at half the speed."""


_USERS: list[Callable[[], list[list[str]]]] = []
"""What gives the flags of users, first."""


@contextmanager
def kernels(folder: Path) -> Iterator[None]:
    """Kernels are compiled with `FLAGS`, into `folder`."""
    from gbspec.backends.native import compiler

    _USERS.append(compiler._flag_sets)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GBSPEC_CACHE", str(folder))
        patch.setattr("gbspec.backends.native.compiler._flag_sets", lambda: [FLAGS])
        patch.setattr("gbspec.training.engines.native.kernel._kernels", {})
        yield


@contextmanager
def optimised() -> Iterator[None]:
    """Kernels are compiled as users' are, for tests of the kernel itself."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbspec.backends.native.compiler._flag_sets", _USERS[0])
        patch.setattr("gbspec.training.engines.native.kernel._kernels", {})
        yield


@contextmanager
def fits(folder: Path) -> Iterator[None]:
    """`--backend auto` takes the compiled kernel however few the data: several times as fast as the torch graph.

    Without a compiler, the torch graph is used.
    """
    with kernels(folder), pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbspec.training.engines.choice.LEAST_SUBSTEPS", 0)
        yield


@contextmanager
def unmeasured() -> Iterator[None]:
    """`--backend auto` decides by the number of sub-steps alone, and so does not depend on the speed of the machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbspec.training.runs.fit.faster_backend", lambda *given: None)
        yield


@contextmanager
def warm_start(steps: int) -> Iterator[None]:
    """The regression of slopes at the beginning of a fit takes fewer steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbspec.training.starts.warm_start.REGRESSION_STEPS", steps)
        yield


@contextmanager
def metrics(**sizes: int) -> Iterator[None]:
    """Comparisons with the truth have other default sizes."""
    import gbspec.data

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbspec.data.MetricsOptions", partial(gbspec.data.MetricsOptions, **sizes))
        yield
