"""Random combinations of contracts, postulates and ranges: either they hold, or they are rejected with a reason."""

from __future__ import annotations

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from gbspec.backends.module import load_module
from gbspec.diagnostics import UserError
from tests.contracts.helpers import model_of, points, weights
from tests.contracts.test_hold import check_agreement, check_values

BOUNDS = [">= 0", "<= 0", ">= -1", "<= 2", "in [0, 1]", "in [-1, 2]", "in [-K, K]", ">= K", "<= v", "in [0, k]", ">= 1"]
PLACES = ["0", "1", "5", "-1", "K", "1 + v^2"]
POSTULATES = [
    "",
    "= nn",
    "= u/(K + u)*nn",
    "= u/(K + u) + nn",
    "= k*u - nn",
    "= 2*exp(-tanh(u))*nn",
    "= u*v/(K + u)*nn",
    "= tanh(u)*exp(tanh(nn))",
    "= u^2/(K^2 + u^2)*(nn + 1)",
    "= -u*nn",
    "= if(u > 1, u, 1)*nn",
]


@st.composite
def statements(draw: st.DrawFn) -> str:
    contracts = draw(st.lists(st.sampled_from(BOUNDS), max_size=2, unique=True))
    for name in ("u", "v"):
        contracts += draw(st.sampled_from([[], [], [f"increasing in {name}"], [f"decreasing in {name}"]]))
        if draw(st.booleans()) and draw(st.booleans()):
            place = draw(st.sampled_from(PLACES if name == "u" else PLACES[:5]))
            contracts.append(f"zero at {name} = {place}")
    for name in ("u", "v"):
        shapes = [f"{kind} in {name}" for kind in ("convex", "concave", "odd", "even", "period 3")]
        contracts += draw(st.sampled_from([[], [], [], *([shape] for shape in shapes)]))
    if draw(st.booleans()) and draw(st.booleans()):
        contracts.append(draw(st.sampled_from(["equals 1 at u = 0", "equals K at v = 1", "equals 0.5 at u = 5"])))
    u = draw(st.sampled_from(["u", "u in [0, 10]", "u in [-5, 5]", "u in [1, 5]"]))
    w = draw(st.sampled_from(["", ", w"]))
    activation = draw(st.sampled_from(["silu", "tanh", "relu", "sin"]))
    text = ", ".join(draw(st.permutations(contracts)))
    postulate = draw(st.sampled_from(POSTULATES))
    return f"unknown f({u}, v in [0, 3]{w}) {text} {postulate} by mlp(7, 9, activation={activation})"


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(statements(), st.integers(0, 2**16))
@example("unknown f(u, v in [0, 3]) >= -1, increasing in v, odd in u, odd in v  by mlp(7, 9)", 0)
@example("unknown f(u in [0, 10], v in [0, 3]) increasing in u, odd in u = tanh(u)*exp(tanh(nn)) by mlp(7, 9)", 0)
@example("unknown f(u, v in [0, 3]) <= 0, >= -1 = 2*exp(-tanh(u))*nn by mlp(7, 9, activation=silu)", 0)
@example("unknown f(u, v in [0, 3]) in [0, k] = u^2/(K^2 + u^2)*(nn + 1) by mlp(7, 9, activation=silu)", 0)
@example(
    "unknown f(u, v in [0, 3]) in [0, 2], zero at u = 0 = u^2/(K^2 + u^2)*(nn + 1) by mlp(7, 9, activation=silu)", 0
)
def test_contracts_hold_or_are_rejected(text: str, seed: int) -> None:
    try:
        model = model_of(text)
    except UserError as error:
        errors = [d for d in error.diagnostics if d.severity.value == "error"]
        assert errors
        assert {d.code for d in errors} <= {"GB603", "GB604", "GB605", "GB607", "GB608", "GB609"}
        assert all(d.message and d.place is not None for d in errors)
        return
    cls = load_module(model)
    check_values(model, cls(weights(cls, seed)), points(model, 0, 60, seed))
    check_agreement(model, cls.random(seed), points(model, 0, 5, seed).clamp(-10, 10))
