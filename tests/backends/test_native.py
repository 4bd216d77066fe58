"""The native kernel has the loss and gradient of the torch graph: bundled models, all constructs, random models."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gbspec
from gbspec.backends.module import load_module
from gbspec.backends.native import CompilerError, Precision, Source, compiled, source
from gbspec.backends.native import compiler as compiling
from gbspec.backends.native.compiler import find_compiler
from gbspec.data.shipped import shipped_models
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories, Trajectory
from gbspec.diagnostics import Defect
from gbspec.ir.methods import Method
from gbspec.ir.model import Model
from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.native.inputs import KernelInputs
from gbspec.training.engines.native.kernel import Kernel
from gbspec.training.engines.native.threads import shared_out
from gbspec.training.engines.objective import objective, predicted
from gbspec.training.problem.forcing import Forcing
from gbspec.training.problem.packing import pack
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from gbspec.training.problem.scaling import scaling_of
from tests import quick, strategies
from tests.backends.same_kernel import compare, compare_jacobians
from tests.training.conftest import EVERYTHING, everything_data, model_of, problem_of, urp_data
from tests.training.reference import half_squares

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def random_problem(model: Model, seed: int, step: float = 0.31) -> tuple[Problem, Parameters, np.ndarray]:
    """A problem of random data for any model: irregular rows, inputs, doses, forcing between 0 and 1."""
    rng = np.random.default_rng(seed)
    items = []
    for i in range(5):
        times = np.sort(rng.uniform(0.1, 1.6, 2 + i))
        span = np.linspace(0.0, 2.0, 4)
        events = (rng.uniform(0.0, 1.5, 2), rng.uniform(0.5, 1.0, 2))
        values = rng.uniform(0.5, 2.0, (len(times), len(model.channels)))
        values[rng.uniform(size=values.shape) < 0.3] = np.nan
        items.append(
            Trajectory(
                label=str(i),
                start=0.0,
                times=times,
                values=values,
                counts=np.isfinite(values).astype(np.float64),
                sd=np.full(values.shape, np.nan),
                condition=rng.uniform(0.2, 1.0, len(model.conditions)),
                inputs=tuple(Signal(span, rng.uniform(0.2, 1.0, 4)) for _ in model.inputs),
                doses=tuple(DoseEvents(*events) for _ in model.doses),
            )
        )
    names = tuple(channel.name for channel in model.channels)
    data = Trajectories(tuple(items), names)
    packed = pack(data, model, step, rng)
    value, weight = rng.uniform(0.5, 1.5, (2, packed.rows, len(model.states)))
    module = load_module(model).random(seed)
    problem = Problem(
        model, module, packed, Forcing(value, np.clip(weight - 0.5, 0.0, 1.0)), scaling_of(model, packed, data)
    )
    fixed = {name: v for name, v in module.weights.items() if name.endswith(("_center", "_scale"))}
    shape = (len(items), len(model.states))
    parameters = Parameters(model, rng.uniform(0.3, 1.0, shape), np.full(shape[1], 0.2), np.ones(shape), fixed)
    theta = parameters.vector(module.weights)
    return problem, parameters, theta + 0.1 * rng.standard_normal(len(theta))


@pytest.fixture
def optimised() -> Iterator[None]:
    with quick.optimised():
        yield


# The stiff ones overflow in explicit steps; tests/training/test_adaptive_steps.py compares their own, and
# tests/events/test_kernel.py the switching ones. Algebraic equations are solved by a search.
WITHOUT_KERNEL = ("robertson", "switching", "chemistry")
SHIPPED = sorted(name for name, path in shipped_models().items() if path.parent.name not in WITHOUT_KERNEL)


@pytest.mark.parametrize("name", SHIPPED)
def test_bundled_models(name: str) -> None:
    problem, parameters, theta = random_problem(gbspec.load(name).model, 1, 0.1)
    compare(problem, parameters, theta, ("float64", "float32"))


@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("blend", [1.0, 0.3, 0.0])
def test_a_model_with_everything(blend: float) -> None:
    problem, parameters, theta = problem_of(model_of(EVERYTHING), everything_data(), 0.13, blend=blend)
    rng = np.random.default_rng(3)
    compare(problem, parameters, theta + 0.1 * rng.standard_normal(len(theta)), ("float64", "float32"))


CONTRACTS = """model contracts
state x in [0, 2]
state y in [0, 2]
input F linear
learn k = 0.5 in [0, 3]
unknown r(x in [0, 3], y in [0, 3]) >= 0, increasing in x, decreasing in y by mlp(9, 7)
unknown g(y in [0, 3]) <= 2, zero at y = 0 by mlp(5)
x' = F - r(x, y) - k*x*g(y)
y' = r(x, y) - g(y)
dose x times 0.3 + 0.4*k
observe x
observe y
"""


def test_contracts_and_doses() -> None:
    problem, parameters, theta = random_problem(model_of(CONTRACTS), 2)
    assert len(problem.packed.doses.time)
    compare(problem, parameters, theta, ("float64", "float32"))


@settings(
    max_examples=4,
    deadline=None,
    derandomize=True,
    suppress_health_check=[*HealthCheck],
)
@given(strategies.models(), st.integers(0, 1000))
def test_random_models(model: Model, seed: int) -> None:
    problem, parameters, theta = random_problem(model, seed, 0.5)
    if np.isfinite(objective(problem, parameters, "torch")(theta)[0]):
        compare(problem, parameters, theta, ("float64", "float32"))


ACTIVATIONS = """model activations
state x in [0, 1]
{unknowns}
x' = {terms} - x
observe x
"""


def test_all_activations() -> None:
    """Every activation, in networks of no, one and three hidden layers, some wider than a vector."""
    names = strategies.ACTIVATIONS
    shapes = ["9", "17, 3, 8"]
    unknowns = "\n".join(f"unknown f{i}(x) by mlp({shapes[i % 2]}, activation={name})" for i, name in enumerate(names))
    text = ACTIVATIONS.format(unknowns=unknowns, terms=" + ".join(f"f{i}(x)" for i in range(len(names))))
    problem, parameters, theta = random_problem(model_of(text), 4)
    compare(problem, parameters, 3 * theta, ("float64",))


@pytest.fixture(scope="module")
def small() -> tuple[Problem, Parameters, np.ndarray, Kernel]:
    from tests.training.conftest import URP

    model = model_of(URP)
    problem, parameters, theta = problem_of(model, urp_data(9, 2.0, 1), 0.1)
    with quick.optimised():
        return problem, parameters, theta, Kernel(model)


def test_some_trajectories_and_threads(small: tuple[Problem, Parameters, np.ndarray, Kernel]) -> None:
    problem, parameters, theta, kernel = small
    index = np.array([7, 2, 3])
    part = problem.take(index)
    loss, gradient = half_squares(kernel, part, parameters.take(index), parameters.take_vector(theta, index))
    found = half_squares(kernel, problem, parameters, theta, index)
    assert found[0] == pytest.approx(loss, rel=1e-13)
    assert np.allclose(parameters.take_vector(found[1], index), gradient, rtol=1e-11, atol=1e-13)
    alone = half_squares(kernel, problem, parameters, theta)
    torch.set_num_threads(2)
    together = half_squares(kernel, problem, parameters, theta)
    assert np.allclose(alone[1], together[1], rtol=1e-12, atol=1e-14 * np.abs(alone[1]).max())


@pytest.mark.parametrize("threads", [1, 2])
def test_work_is_shared_out_among_several_threads_alone(
    small: tuple[Problem, Parameters, np.ndarray, Kernel], threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, parameters, theta, kernel = small
    engine, counts = NativeEngine(problem, parameters, kernel), list[int]()

    def one_after_the_other(part: Callable[[int], None], count: int, _: int) -> None:
        counts.append(count)
        for i in range(count):
            part(i)

    monkeypatch.setattr("gbspec.training.engines.native.kernel.shared_out", one_after_the_other)
    tables = engine.tables(engine.plan(theta))
    found = kernel.sweep(tables, KernelInputs.of(problem, parameters, torch.from_numpy(theta)), True, threads=threads)
    assert np.isfinite(found.d_weights).all() and len(counts) == threads - 1 and all(count > 1 for count in counts)


def test_any_cotangent(small: tuple[Problem, Parameters, np.ndarray, Kernel]) -> None:
    """Products of the transposed Jacobian with any vector, linear in it; with the residuals it is the gradient."""
    problem, parameters, theta, kernel = small
    engine = NativeEngine(problem, parameters, kernel)
    inputs = KernelInputs.of(problem, parameters, torch.from_numpy(theta))
    tables = engine.tables(engine.plan(theta))
    own = kernel.sweep(tables, inputs, True)
    again = kernel.sweep(tables, inputs, True, 3 * own.residuals)
    assert np.allclose(again.d_weights, 3 * own.d_weights, rtol=1e-12, atol=1e-12)


def test_an_error_in_the_calling_thread_stops_the_others() -> None:
    """The other threads read arrays that belong to it."""
    asking, raised, done = threading.get_ident(), threading.Event(), []

    def part(i: int) -> None:
        if threading.get_ident() == asking:
            raised.set()
            raise KeyboardInterrupt
        raised.wait()
        time.sleep(0.05)
        done.append(i)

    with pytest.raises(KeyboardInterrupt):
        shared_out(part, 50, 3)
    before = len(done)
    time.sleep(0.2)
    assert len(done) == before < 49


def test_memory_does_not_grow_with_the_length(
    small: tuple[Problem, Parameters, np.ndarray, Kernel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trajectories with checkpointing have the same gradient, and the work space is bounded."""
    problem, parameters, theta, kernel = small
    assert kernel.work_bytes(100_000) < 8 * 2**20
    monkeypatch.setattr(sys.modules["gbspec.backends.native.kernel_text"], "KEPT_BYTES", 100_000)
    short = Kernel(problem.model)
    assert short.work_bytes(problem.packed.depth) < kernel.work_bytes(problem.packed.depth)
    expected, found = (half_squares(k, problem, parameters, theta) for k in (kernel, short))
    assert found[0] == pytest.approx(expected[0], rel=1e-14)  # sums of other lengths are contracted otherwise
    assert np.allclose(found[1], expected[1], rtol=1e-12, atol=1e-14 * np.abs(expected[1]).max())


INVARIANT = """model invariant
state x in [0, 2]
state y in [0, 2]
unknown g(y in [0, 3]) by mlp(5, 4)
x' = 0.3 - 0.2*x
y' = x - g(y) + g(1.0)
observe x
"""


def test_jacobians_of_intervals_longer_than_what_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The model has a call that is made once for a whole interval, and every checkpoint interval needs its slopes."""
    problem, parameters, theta = random_problem(model_of(INVARIANT), 3, step=0.02)
    compare_jacobians(problem, parameters, theta)
    monkeypatch.setattr(sys.modules["gbspec.backends.native.kernel_text"], "KEPT_BYTES", 20_000)
    monkeypatch.setattr("gbspec.training.engines.native.kernel._kernels", {})
    compare_jacobians(problem, parameters, theta)


def test_a_blow_up_gives_no_finite_loss(small: tuple[Problem, Parameters, np.ndarray, Kernel]) -> None:
    problem, parameters, theta, kernel = small
    wild = theta.copy()
    wild[: parameters.n_weights] *= 1e6
    with np.errstate(all="ignore"):
        loss, _ = half_squares(kernel, problem, parameters, wild)
    assert not np.isfinite(loss)


OVERFLOW = """model overflow
state x in [0, 2]
state z in [0, 2]
learn k = 0.5 in [0, 3]
unknown g(x) by mlp(5)
x' = -k*x + g(x) + 1/(1 + z)
z' = {rate}
observe x
"""


@pytest.mark.parametrize("weight", [None, 0.0, 1.0])
def test_an_overflow_that_no_measurement_sees(weight: float | None) -> None:
    """An infinite state with bounded effect: the measured values stay finite, with resets of any weight."""
    problem, parameters, theta = random_problem(model_of(OVERFLOW.format(rate="1e90*z")), 2)
    if weight is not None:
        forcing = problem.forcing
        problem = replace(problem, forcing=replace(forcing, weight=np.full_like(forcing.weight, weight)))
    assert np.isinf(predicted(NativeEngine(problem, parameters, Kernel(problem.model)), theta).before).any()
    expected, found = (objective(problem, parameters, backend)(theta) for backend in ("torch", "native"))
    assert np.isfinite(expected[0])
    assert np.isfinite(expected[1]).all()
    assert found[0] == pytest.approx(expected[0], rel=1e-12)
    assert found[1] == pytest.approx(expected[1], rel=1e-11, abs=1e-13)


def test_a_trajectory_that_has_ended_waits_for_longer_ones() -> None:
    """Its last state is so large that the derivatives of the rates, which are not needed, are infinite there."""
    text = OVERFLOW.format(rate="c*z + k").replace("1/(1 + z)", "1/(1 + z^10)\ncondition c in [0, 1]")
    problem, parameters, theta = random_problem(model_of(text), 2, step=2.0)
    packed, weight = problem.packed, np.zeros_like(problem.forcing.weight)
    short = int(np.argsort(packed.steps)[1])  # the shortest has a tile to itself
    last = np.flatnonzero(packed.row_trajectory == short)[-1]
    h = packed.h[packed.steps[short] - 1, short]
    weight[:, 1] = np.arange(packed.rows) != last
    condition = np.where(np.arange(packed.trajectories) == short, 1e10 / h, 0.0)[:, None]
    forcing = replace(problem.forcing, weight=weight)
    problem = replace(problem, packed=replace(packed, condition=condition), forcing=forcing)
    expected, found = (objective(problem, parameters, backend)(theta) for backend in ("torch", "native"))
    assert np.isfinite(expected[1]).all()
    assert found[1] == pytest.approx(expected[1], rel=1e-11, abs=1e-13)


# ---------------------------------------------------------------- compilation
def test_arrays_that_c_would_misread_are_rejected(small: tuple[Problem, Parameters, np.ndarray, Kernel]) -> None:
    problem, _, _, kernel = small
    given = {"count": 2, "first": 0, "stride": 1, "gradient": 0, "order": np.arange(2), "cotangent": None}
    right, weights = kernel.library.struct, np.zeros(kernel.library.sizes["WEIGHTS"])
    right("Share", **given, d_weights=weights)
    for name, wrong in (
        ("order", np.arange(3)),
        ("order", np.arange(2.0)),
        ("order", np.arange(4)[::2]),
        ("cotangent", np.zeros((3, len(problem.model.channels) + 1))),
        ("d_weights", weights[:-1]),
        ("d_weights", weights.astype(np.float32)),
        ("d_weights", None),
        ("count", 2.0),
    ):
        with pytest.raises(Defect, match=f"Share.{name}"):
            right("Share", **{**given, "d_weights": weights, name: wrong})
    weights.flags.writeable = False
    with pytest.raises(Defect, match="d_weights"):
        right("Share", **given, d_weights=weights)
    with pytest.raises(Defect, match="no or superfluous d_weights"):
        right("Share", **given)


def test_kernels_are_cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GBSPEC_CACHE", str(tmp_path))
    text = "int answer(void) { return 42; }\n"
    assert compiled(text).answer() == 42
    assert [path.suffix for path in tmp_path.iterdir()] == [".so"]
    monkeypatch.setattr(compiling, "_loaded", {})
    monkeypatch.setattr(compiling, "_compile", lambda *_: pytest.fail("compiled again"))
    assert compiled(text).answer() == 42


def test_a_compiler_failure_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GBSPEC_CACHE", str(tmp_path))
    with pytest.raises(CompilerError, match="cannot compile"):
        compiled("this is no C\n")
    assert list(tmp_path.iterdir()) == []


def test_no_instruction_set_is_assumed(
    small: tuple[Problem, Parameters, np.ndarray, Kernel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Standard C, where a vector is one number."""
    problem, parameters, theta, kernel = small

    def plain(model: Model, precision: Precision, method: Method, blocks: int) -> Source:
        whole = source(model, precision, method, blocks)
        return replace(whole, text="#define PLAIN_C\n" + whole.text)

    monkeypatch.setattr("gbspec.training.engines.native.kernel.source", plain)
    expected, found = (half_squares(k, problem, parameters, theta) for k in (kernel, Kernel(problem.model)))
    assert found[0] == pytest.approx(expected[0], rel=1e-13)
    assert np.allclose(found[1], expected[1], rtol=1e-12, atol=1e-14 * np.abs(expected[1]).max())


def test_a_library_that_others_could_have_written_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gbspec.backends.native import compiler

    monkeypatch.setattr(compiler, "_flag_sets", lambda: [["-shared", "-fPIC"]])
    monkeypatch.setattr(compiler, "_own", [])
    source = "int answer(void) { return 42; }"

    def answer(folder: Path) -> tuple[int, str]:
        monkeypatch.setenv("GBSPEC_CACHE", str(folder))
        monkeypatch.setattr(compiler, "_loaded", {})
        library = compiler.compiled(source)
        return library.answer(), library._name

    own = tmp_path / "own"
    assert answer(own) == (42, str(next(own.glob("*.so"))))
    assert own.stat().st_mode & 0o077 == 0
    path = next(own.glob("*.so"))
    planted = tmp_path / "planted.so"
    planted.write_bytes(path.read_bytes())
    for mode in (0o777, 0o702):  # anybody's file
        path.chmod(mode)
        assert not compiler.trusted(path)
        assert answer(own)[0] == 42 and compiler.trusted(path), "it is compiled again"
    path.unlink()
    path.symlink_to(planted)
    assert answer(own)[0] == 42 and not path.is_symlink()
    own.chmod(0o777)  # anybody's folder: one of this process is used
    found, name = answer(own)
    assert found == 42 and not name.startswith(str(tmp_path)), name
    own.chmod(0o700)
    tmp_path.chmod(0o777)  # in which anybody could rename it
    assert not compiler.trusted(own)
    tmp_path.chmod(0o1777)
    assert compiler.trusted(own)
