"""What is said of residuals and innovations that are not independent, and the statements that are offered."""

from __future__ import annotations

import pytest

from gbspec.runs import ChannelRecord, LikelihoodRecord, NoiseRecord, WhitenessRecord
from gbspec.training.runs.verdict import autocorrelations, innovations
from tests.training.conftest import model_of


def test_autocorrelated_residuals_offer_the_statement_of_a_disturbance() -> None:
    model = model_of("model m\ntime t : h\nstate x : K = 1\nlearn k : 1/h = 1\nx' = -k*x\nobserve x\n")
    followed = {"x": ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)}
    (said,) = autocorrelations(followed, model, {"x": 0.123})
    assert "`learn s_x : K/h^0.5 = 0.1 > 0` and `diffusion x = s_x`" in said
    text = f"{model.text}learn s_x : K/h^0.5 = 0.1 > 0\ndiffusion x = s_x\n"
    (said,) = autocorrelations(followed, model_of(text), {})
    assert "lacks more" in said


def test_disturbances_are_in_proportion_where_errors_of_measurement_are() -> None:
    """Additive ones of the size of the largest values would hide all that is small."""
    text = "model m\ntime t : h\nstate x : K = 1\nstate y : K = 1\nlearn k : 1/h = 1\nx' = -k*x\ny' = k*x - k*y\n"
    model = model_of(f"{text}observe x noise lognormal(0.3)\nobserve y\n")
    one = ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)
    (said,) = autocorrelations({"x": one, "y": one}, model, {"x": 12.3, "y": 2.0}, noise={"x": 0.42, "y": 2.0})
    first = "`learn s_x : 1/h^0.5 = 0.4 > 0` and `diffusion x = s_x*x`"
    assert f"{first}, `learn s_y : K/h^0.5 = 2 > 0` and `diffusion y = s_y`" in said
    lines = "learn s_x : 1/h^0.5 = 0.4 > 0\ndiffusion x = s_x*x\nlearn s_y : K/h^0.5 = 2 > 0\ndiffusion y = s_y\n"
    assert len(model_of(model.text + lines).diffusions) == 2


PENDULUM = """model m
time t : s
state th : deg in [-10, 90]
state w : deg/s in [-300, 300]
input u : percent held
learn g : deg/s^2 = 10
th' = w
w' = -g*sin(th in rad)
observe th
"""


@pytest.mark.parametrize(
    ("text", "statements"),
    [
        (PENDULUM, "of `w`, from which `th` follows exactly, add the lines `learn s_w : deg/s/s^0.5 = 4 > 0` and"),
        (PENDULUM.replace("th' = w", "const r = 2\nlet v : deg/s = w*r\nth' = v"), "of `w`, from which `th` follows"),
        (PENDULUM.replace("th' = w", "learn r = 2\nth' = r*w"), "of `th`, add the lines"),
        (PENDULUM.replace("th' = w", "const k : 1/s = 2\nth' = w - k*th"), "of `th`, add the lines"),
        (PENDULUM.replace("th' = w", "const k : s/deg = 2\nth' = k*w^2"), "of `th`, add the lines"),
        (
            PENDULUM.replace("th' = w", "const k : deg/s = 2\nth' = (w + k*(u in 1))/3 + k"),
            "of `w`, from which `th` follows",
        ),
        (PENDULUM.replace("th' = w", "th' = w*(u in 1)"), "of `th`, add the lines"),
        (PENDULUM.replace("th' = w", "th' = if(u > 0, w, 0)"), "of `th`, add the lines"),
        (PENDULUM.replace("th' = w", "const k : deg/s = 2\nth' = w + if(u > 0, k, 0)"), "of `th`, add the lines"),
        (PENDULUM.replace("w' = -g*sin(th in rad)", "const k : 1/s^2 = 2\nw' = -k*th"), "of `th`, add the lines"),
    ],
)
def test_not_a_position_but_its_rate_is_offered_a_disturbance(text: str, statements: str) -> None:
    followed = {"th": ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)}
    (said,) = autocorrelations(followed, model_of(text), {"th": 0.65})
    assert f"To describe disturbances {statements}" in said


def test_all_channels_with_autocorrelated_residuals_are_offered_a_disturbance() -> None:
    model = model_of("model m\nstate x = 1\nstate y = 1\nlearn k = 1\nx' = -k*x\ny' = x - y\nobserve x\nobserve y\n")
    one = ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)
    (said,) = autocorrelations({"x": one, "y": one}, model, {"x": 0.1, "y": 2.0})
    assert "`diffusion x = s_x`" in said and "`learn s_y = 2 > 0` and `diffusion y = s_y`" in said


def test_of_many_states_the_first_shows_the_statement_and_the_others_are_listed() -> None:
    states = "".join(f"state {x} : K = 1\n{x}' = -k*{x}\nobserve {x}\n" for x in "xyzw")
    model = model_of(f"model m\ntime t : h\nlearn k : 1/h = 1\n{states}")
    one = ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)
    (said,) = autocorrelations(dict.fromkeys("xyzw", one), model, {"x": 0.123, "y": 2.0, "z": 0.3, "w": 1.0})
    assert "the residuals of `x` (correlation 0.9 with the next row's), `y` (0.9), `z` (0.9), `w` (0.9) are" in said
    assert said.count("diffusion") == 1 and "`learn s_x : K/h^0.5 = 0.1 > 0` and `diffusion x = s_x`" in said
    assert said.endswith("; likewise for `y`, `z`, `w` (from 2, 0.3, 1)")


def test_models_with_events_are_not_offered_a_disturbance() -> None:
    """`check` refuses both in one model (GB351)."""
    model = model_of("model m\nstate x = 1\nlearn k = 1\nx' = -k*x\nevent e when x <= 0.5: x = 1\nobserve x\n")
    (said,) = autocorrelations({"x": ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)}, model, {"x": 0.1})
    assert "diffusion" not in said


@pytest.mark.parametrize(("p", "said"), [(1e-20, True), (0.09, False), (None, False)])
def test_innovations_that_are_not_independent_are_told(p: float | None, said: bool) -> None:
    white = WhitenessRecord(336, 20, 100.0, 1e-30, 0.1, 0.1, p) if p else WhitenessRecord(3, 0, None, None, None, None)
    likelihood = LikelihoodRecord("l", 1.0, 3, 336, 1.0, 1.0, {"x": NoiseRecord(0.08, 0.1, (0.07, 0.1))}, {"x": white})
    found = innovations({"x": ChannelRecord(0.9, 0.0, autocorrelation=0.3, pairs=300)}, likelihood)
    assert len(found) == said and all("`d' = -d/tau`" in text and "`x` (probability 1e-20)" in text for text in found)


def test_innovations_that_only_their_correlation_shows_are_told_with_it() -> None:
    """A probability of 0.16 would say the opposite of the warning."""
    white = WhitenessRecord(139, 20, 45.0, 9e-4, 0.2, 1e-6, 0.16)
    likelihood = LikelihoodRecord("l", 1.0, 3, 139, 1.0, 1.0, {}, {"x": white})
    (text,) = innovations({"x": ChannelRecord(0.9, 0.0, autocorrelation=0.435, pairs=138)}, likelihood)
    assert "`x` (correlation 0.435 with the next row's) are not independent" in text and "probability" not in text
    assert "may be too narrow" in text and "interval of a mean would have to be 1.6 times as wide" in text


@pytest.mark.parametrize(
    ("disturbance", "said"),
    [
        ("d' = -d/tau", "`d` is a disturbance with a memory already. What may help: one of second order (`state d2_ ="),
        ("d' = 0", "`d` is a disturbance with a memory already"),
        ("d' = -d/tau + u", "a disturbance with a memory (`state d_ = 0`, `d_' = -d_/tau_`"),
    ],
)
def test_a_model_is_not_advised_to_add_the_disturbance_that_it_has(disturbance: str, said: str) -> None:
    model = model_of(
        "model m\ninput u held\nstate x = 0\nstate d = 0\nlearn d2 = 1 > 0\nlearn tau = 1 > 0\n"
        f"x' = d2*u - x\n{disturbance}\ndiffusion d = 0.1\nobserve y = x + d\n"
    )
    white = WhitenessRecord(336, 20, 100.0, 1e-30, 0.1, 0.1, 1e-9)
    likelihood = LikelihoodRecord("l", 1.0, 3, 336, 1.0, 1.0, {}, {"y": white})
    (text,) = innovations({"y": ChannelRecord(0.9, 0.0)}, likelihood, model)
    assert said in text
    assert ("`+ d2_` in the balance of `d`), a dead time of an input" in text) == ("already" in said)


def test_a_learned_noise_that_went_to_zero_is_told() -> None:
    likelihood = LikelihoodRecord("l", 1.0, 3, 336, 1.0, 1.0, {"x": NoiseRecord(2.4e-6, None, None)}, {})
    (said,) = innovations({}, likelihood)
    assert "`x` (2.4e-06)" in said and "`noise normal(…)`" in said


def test_a_learned_noise_as_large_as_the_errors_has_not_gone_to_zero() -> None:
    likelihood = LikelihoodRecord("l", 1.0, 3, 336, 1.0, 1.0, {"x": NoiseRecord(0.56, None, None)}, {})
    (said,) = innovations({}, likelihood, None, {"x": 0.54})
    assert "`x` (0.56) has no interval" in said and "gone to zero" not in said


def test_autocorrelated_residuals_of_a_population_are_not_said_to_widen_its_intervals() -> None:
    """Its likelihood takes them for independent, and `diffusion` is not offered together with distributions."""
    text = "model m\ntime t : h\nstate x : K = 1\nlearn k : 1/h = 1 > 0 per trajectory ~ lognormal\n"
    model = model_of(text + "x' = -k*x\ninitial x = 1\nobserve x\n")
    followed = {"x": ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)}
    (said,) = autocorrelations(followed, model, {"x": 0.123})
    assert "too narrow" in said and "times as wide" not in said
    assert "`diffusion" not in said


def test_the_start_of_a_disturbance_is_written_as_people_write_it() -> None:
    model = model_of("model m\nstate x = 1\nlearn k = 1\nx' = -k*x\nobserve x\n")
    (said,) = autocorrelations({"x": ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)}, model, {"x": 12.3})
    assert "`learn s_x = 10 > 0`" in said
