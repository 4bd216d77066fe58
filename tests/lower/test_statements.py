"""Lowering of statements to the parts of the Model."""

from __future__ import annotations

import dataclasses
import math
from math import inf
from pathlib import Path

import pytest
import sympy

from gbspec.ir.dumping import dump
from gbspec.ir.model import Dose, Noise, Prior, Range, State, symbol, unknown_function
from gbspec.semantics.numbers import default_start
from tests.texts import SHIPPED, model_at, model_of


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_the_kept_text_means_the_same_model(path: Path) -> None:
    model = model_at(path)
    again = model_of(model.text)
    assert dump(again) == dump(model)
    assert dataclasses.replace(again, text=model.text) == model


def test_everything_of_a_model() -> None:
    model = model_of(
        'model full "Everything"\ntime tau : h from 2\n'
        'state X : g/L in [0, 50] = 0.1 "biomass"\nstate S\nstate P\n'
        'condition Da in [0.2, 0.5] = 0.3 as "Da number"\ninput F : L/h held as "feed"\ninput G linear\n'
        "const a = 2\nlearn k = 1 > 0\nlearn Y in [1e-4, 1] prior lognormal(0.1, 0.5) per trajectory\n"
        "let r = k*F\nunknown mu, nu(S, g in [0, 5]) : 1/h, g/L/h = S*nn, nn + a*nn by mlp(8, 4, activation=tanh)\n"
        "process growth: 1/Y*S + a*S -> X rate mu(S, G)*X\n"
        "X' = net(X) - r*X\nP' = growth - nu(S, Da)\n"
        "initial X learn\ninitial S = 2*k*Da + P\n"
        'observe X noise normal(0.05)\nobserve y = 2*S : g/L noise lognormal(0.1) as "OD 600"\n'
        "observe r\nobserve S_too = S\n"
        "dose S times Y lag 2*tl\nlearn tl = 1\n"
        "truth k = 3*a\ntruth mu(S, h) = k*S*h\nallow GB403 spare\nconst spare = 1\n"
    )
    X, S, F, k, Y = (symbol(n) for n in ("X", "S", "F", "k", "Y"))
    assert (model.name, model.title, model.class_name) == ("full", "Everything", "Full")
    assert (model.time.name, model.time.start, model.time.unit) == ("tau", 2.0, "h")
    first, second, third = model.states
    assert first == dataclasses.replace(
        State("X", Range(0, 50), 0.1, unit="g/L", description="biomass"), initial=first.initial
    )
    assert [s.initial.kind for s in model.states] == ["learned", "expression", "measured"]
    assert second.initial.value == 2 * k * symbol("Da") + symbol("P")
    assert third.range is None
    (condition,) = model.conditions
    assert (condition.default, condition.column, condition.range) == (0.3, "Da number", Range(0.2, 0.5))
    assert [(i.name, i.interpolation, i.column) for i in model.inputs] == [("F", "held", "feed"), ("G", "linear", "G")]
    assert [(c.name, c.value) for c in model.constants] == [("a", 2.0), ("spare", 1.0)]
    learn_k, learn_Y, learn_tl = model.learnables
    assert (learn_k.start, learn_k.range) == (1.0, Range(0, math.inf))
    assert learn_Y.start == pytest.approx(0.1), "the center of the prior"
    assert learn_Y.prior == Prior("lognormal", 0.1, 0.5)
    assert learn_Y.per_trajectory
    (network,) = model.networks
    assert (network.hidden, network.activation, network.outputs) == ((8, 4), "tanh", ("mu", "nu"))
    assert network.arguments[1].range == Range(0, 5)
    assert [u.unit for u in model.unknowns] == ["1/h", "g/L/h"]
    assert [u.neutral for u in model.unknowns] == [1.0, 0.0]
    assert [(i.name, i.kind) for i in model.intermediates] == [("r", "let"), ("growth", "rate")]
    assert model.intermediates[1].value == unknown_function("mu")(S, symbol("G")) * X
    growth = symbol("growth")
    assert dict(model.processes[0].stoichiometry) == {"S": -1 / Y - symbol("a"), "X": sympy.S.One}
    assert model.balances[0] == growth - symbol("r") * X
    assert sympy.expand(model.balances[1] + growth * (1 / Y + symbol("a"))) == 0
    assert model.balances[2] == growth - unknown_function("nu")(S, symbol("Da"))
    assert [(c.name, c.state, c.column) for c in model.channels] == [
        ("X", 0, "X"),
        ("y", None, "OD 600"),
        ("r", None, "r"),
        ("S_too", 1, "S_too"),
    ]
    assert [c.noise for c in model.channels[:2]] == [Noise("normal", 0.05), Noise("lognormal", 0.1)]
    assert model.doses == (Dose("S", Y, 2 * learn_tl.symbol),)
    assert [(t.name, t.value) for t in model.truth_constants] == [("k", 6.0)]
    assert model.truth_functions[0].value == k * S * symbol("h")
    assert model.allowed == (("GB403", "spare"),)
    assert F in model.intermediates[0].value.free_symbols


def test_lets_are_substituted_where_only_constants_may_occur() -> None:
    model = model_of(
        "model m\nstate A\nstate B\nlearn y = 1\nlet twice = 2*y\nlet more = twice + 1\n"
        "process p: A -> more*B rate A\ninitial A = more\nobserve A\n"
    )
    y = symbol("y")
    assert dict(model.processes[0].stoichiometry)["B"] == 2 * y + 1
    assert model.states[0].initial.value == 2 * y + 1


@pytest.mark.parametrize(
    ("low", "high", "start"),
    [(0, 10, 5), (1, 10, 5.5), (1, 10000, 100), (-4, 2, -1), (0, inf, 1), (20, inf, 40), (-inf, 0, -1), (-inf, -3, -6)],
)
def test_default_start(low: float, high: float, start: float) -> None:
    assert default_start(low, high) == pytest.approx(start)


@pytest.mark.parametrize(
    ("unit", "text"),
    [("g/L", "g/L"), ("g/(L*h)", "g/(L*h)"), ("(g/L)^2", "(g/L)^2"), ("10^3 * L", "10^3*L"), ("h^-1", "h^-1")],
)
def test_unit_text(unit: str, text: str) -> None:
    model = model_of(f"model m\nstate x : {unit}\nx' = -x\nobserve x\n")
    assert model.states[0].unit == text


def test_one_bound_is_enough_to_start_from() -> None:
    model = model_of("model m\nstate x\nlearn k > 0\nx' = -k*x\nobserve x\n")
    assert model.learnables[0].start == 1.0


def test_a_unit_of_several_outputs_is_that_of_each() -> None:
    model = model_of("model m\nstate x : g\ntime t : h\nunknown f, g(x) : g/h by mlp(4)\nx' = f - g\nobserve x\n")
    assert [unknown.unit for unknown in model.unknowns] == ["g/h", "g/h"]


@pytest.mark.parametrize("noise", ["normal(s)", "student(s, 5)", "student(0.1, 5)"])
def test_beside_a_noise_that_needs_the_likelihood_every_channel_gets_one(noise: str) -> None:
    model = model_of(f"model m\nstate x\nlearn s = 1 > 0\nx' = -x*s\nobserve x\nobserve y = x noise {noise}\n")
    assert model.marginal and all(channel.noise is not None for channel in model.channels)
    assert [one.name for one in model.implied] == ["noise_x"]


def test_the_spread_of_a_population_starts_in_proportion_to_what_varies() -> None:
    model = model_of(
        "model m\ntime t : h\nstate x : g\nlearn k : 1/h = 4 in [0.1, 50] per trajectory ~ normal\n"
        "learn b : g/h = 0.1 in [0.001, 1] per trajectory ~ lognormal\nx' = -k*x + b\nobserve x\n"
    )
    spreads = {one.name: (one.start, one.unit) for one in model.implied if one.name.startswith("sd_")}
    assert [(one.start, one.unit) for one in model.implied if one.name == "noise_x"] == [(1.0, None)]
    assert spreads == {"sd_k": (pytest.approx(0.3 * 4), "1/h"), "sd_b": (0.3, None)}


def test_the_range_of_a_single_value_is_that_of_its_distribution() -> None:
    lines = [f"learn {name} = 1 in [0.5, 3] per trajectory ~ {name}" for name in ("lognormal", "normal", "logitnormal")]
    sums = "lognormal + normal + logitnormal"
    model = model_of("\n".join(["model m", "state x", *lines, f"x' = -x*({sums})", "observe x"]) + "\n")
    found = {one.name: one.individual.range for one in model.learnables}
    assert found == {"lognormal": Range(0.0, inf), "normal": Range(-inf, inf), "logitnormal": Range(0.5, 3.0)}


@pytest.mark.parametrize(("noise", "learned"), [("a", True), ("0.1*x", True), ("a*x", True), ("2*b", False)])
def test_a_noise_is_learned_if_it_depends_on_learned_constants_or_the_prediction(noise: str, learned: bool) -> None:
    text = f"model m\nstate x\nlearn a = 1 > 0\nconst b = 2\nx' = -a*x\nobserve x noise normal({noise})\n"
    found = model_of(text).channels[0].noise
    assert found is not None and math.isnan(found.scale) == learned and (found.value is not None) == learned


def test_learned_noises_with_one_expression_are_equal() -> None:
    # the scale is not a number, and each NaN differs from every other
    a, b = symbol("a"), symbol("b")
    first, again, other = (Noise("normal", float("nan"), value) for value in (a, a, b))
    assert first == again and hash(first) == hash(again) and first != other
    assert first != Noise("lognormal", float("nan"), a)
    assert Noise("normal", 0.1) == Noise("normal", 0.1) != Noise("normal", 0.2) != "normal"


def test_an_effect_starts_at_zero_which_is_that_of_a_trajectory_unknown_to_the_fit() -> None:
    lines = ("state x = 1", "effect e per trajectory", "unknown f(x, e) by mlp(2)", "x' = -f(x, e)", "initial x = 1")
    made = model_of("\n".join(("model m", *lines, "observe x", "")))
    (effect,) = [item for item in made.learnables if item.name == "e"]
    assert effect.start == 0.0 and effect.per_trajectory and effect.distribution is not None
