"""What makes whole fits quick in tests that are about something else than the fit; see `tests/quick.py`."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import quick

FIRST = ("training", "backends", "runs", "studies", "filter", "delays", "events", "algebraic", "benchmarks", "cli")
"""Folders whose files take longest: a long file at the end would leave the other process without work."""


def pytest_configure() -> None:
    """Garbage is looked for more seldom: with torch and sympy in memory that takes 6 to 12 % of the processor time."""
    gc.set_threshold(20_000, 20, 100)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The folders that take longest come first."""
    place = {name: number for number, name in enumerate(FIRST)}
    items.sort(key=lambda item: place.get(item.path.parent.name, len(FIRST)))


def pytest_collection_finish() -> None:
    """What the collection made stays until the end, so no search for garbage looks at it again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def _interruptible() -> None:
    """Ctrl-C interrupts, as in a terminal: a shell starts its commands in the background with SIGINT ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def _short_warm_start() -> Iterator[None]:
    """A warm start cut short, in all tests alike: what follows it makes up for that on small problems."""
    with quick.warm_start(100):
        yield


@pytest.fixture(autouse=True, scope="session")
def _backend_by_size() -> Iterator[None]:
    """Backends are chosen by the number of sub-steps, and no kernel is compiled for small problems."""
    with quick.unmeasured():
        yield


@pytest.fixture(autouse=True, scope="session")
def _no_waiting_for_the_disk() -> Iterator[None]:
    """Nothing that a test can see depends on what a disk has after the power fails."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True, scope="session")
def _few_replicates() -> Iterator[None]:
    """Predictive checks of populations simulate few data sets: they are seldom what is tested."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbspec.training.population.results.REPLICATES", 20)
        yield


@pytest.fixture(scope="session")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the kernels that the tests compile, shared by the processes that run them."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "kernels"


@pytest.fixture(autouse=True, scope="session")
def _cheap_kernels(kernels: Path) -> Iterator[None]:
    """The compiler spends most of its time on optimisations; tests/backends/test_native.py has kernels with them."""
    with quick.kernels(kernels):
        yield


@pytest.fixture(scope="module")
def quick_fits(kernels: Path) -> Iterator[None]:
    """Fits by the compiled kernel in a whole file of tests, the fixtures of the file among them."""
    with quick.fits(kernels):
        yield


@pytest.fixture
def quick_fit(kernels: Path) -> Iterator[None]:
    """The same in a single test."""
    with quick.fits(kernels):
        yield


@pytest.fixture(scope="module")
def few_points() -> Iterator[None]:
    """`validate` compares with the truth at fewer points than by default."""
    with quick.metrics(conditions=4, points=3, rhs_points=50):
        yield
