"""Constants that differ between groups of trajectories: against closed forms, derivatives, and fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gbspec import open_run as run_of
from gbspec.analysis.prediction import said_of_groups
from gbspec.data import SimulateOptions, Trajectories, Trajectory
from gbspec.diagnostics import Findings, UserError
from gbspec.fitted import table_of
from gbspec.ir import Model
from gbspec.operations import models, tables
from gbspec.report.html import tables as report_tables
from gbspec.report.text import likelihood_lines, population_lines
from gbspec.runs import open_run
from gbspec.training import TrainOptions, train
from gbspec.training.population import Groups
from gbspec.training.runs.populations import left_out
from tests.training.test_populations import DECAY, LEVEL, assert_slopes_of_constants, marginal_of, model_of

NESTED = LEVEL.replace("~ normal(s)", "~ normal(s) per strain ~ normal(w)\nlearn w = 0.8 > 0")
ALONE = LEVEL.replace("per trajectory ~ normal(s)", "per strain ~ normal(s)")
DECAYS = DECAY.replace("learn x0 = 2 in [0.1, 20]", "learn x0 = 2 in [0.1, 20] per strain ~ lognormal(0.4)")
STRAINS, SUBJECTS, TIMES = 6, 4, 4


def strains(folder: Path, text: str, site: bool = False) -> tuple[Model, Trajectories, np.ndarray]:
    """A model and data of six strains with four trajectories each, values [24, 4]."""
    random = np.random.default_rng(0)
    level = 5 + 1.2 * random.standard_normal((STRAINS, 1, 1)) + 0.7 * random.standard_normal((STRAINS, SUBJECTS, 1))
    values = (level + 0.4 * random.standard_normal((STRAINS, SUBJECTS, TIMES))).reshape(-1, TIMES)
    if text == DECAYS:
        values = 2 * np.exp(0.1 * (values - 5) - 0.5 * np.arange(TIMES))
    rows = ["trajectory,t,x,strain" + (",site" if site else "")]
    for i, row in enumerate(values.tolist()):
        more = f",{i % 3}" if site else ""
        rows += [f"{i},{t},{y!r},{1 + i // SUBJECTS}{more}" for t, y in enumerate(row)]
    (folder / "data.csv").write_text("\n".join(rows) + "\n")
    model = model_of(text, folder)
    return model, tables.read_data(folder / "data.csv", model, Findings()), values


def exact(values: np.ndarray, between_strains: float, between: float, noise: float) -> float:
    """Minus twice the log likelihood with the mean 5."""
    n = SUBJECTS * TIMES
    covariance = between_strains**2 * np.ones((n, n)) + noise**2 * np.eye(n)
    covariance += between**2 * np.kron(np.eye(SUBJECTS), np.ones((TIMES, TIMES)))
    off = values.reshape(STRAINS, n) - 5
    squares = np.einsum("si,ij,sj->", off, np.linalg.inv(covariance), off)
    return float(off.size * np.log(2 * np.pi) + STRAINS * np.linalg.slogdet(covariance)[1] + squares)


@pytest.mark.parametrize("long", [False, True], ids=["wide", "long"])
def test_groups_may_have_names(tmp_path: Path, long: bool) -> None:
    """They only tell trajectories apart, and are the same number in every table."""
    model, numbered, _ = strains(tmp_path, ALONE)
    names = ["K-12", "wild type", "3b", "x", "é", "last"]
    head, *rows = (tmp_path / "data.csv").read_text().splitlines()
    cells = [(*row.split(",")[:3], names[int(row.split(",")[3]) - 1]) for row in rows]
    if long:
        head = "trajectory,t,name,value"
        rows = [f"{a},{t},x,{x}\n{a},{t},strain,{word}" for a, t, x, word in cells]
    else:
        rows = [",".join(cell) for cell in cells]
    (tmp_path / "named.csv").write_text("\n".join([head, *rows]) + "\n")
    named = tables.read_data(tmp_path / "named.csv", model, Findings())
    pairs = {(one.condition[0], other.condition[0]) for one, other in zip(numbered.items, named.items, strict=True)}
    assert len(pairs) == STRAINS == len({word for _, word in pairs})
    part = [head, *(row for row in rows if "last" in row or row.startswith("23,"))]
    (tmp_path / "part.csv").write_text("\n".join(part) + "\n")
    last = tables.read_data(tmp_path / "part.csv", model, Findings())
    assert {one.condition[0] for one in last.items} == {named.items[-1].condition[0]}


@pytest.mark.parametrize(("text", "spreads"), [(NESTED, (0.8, 1.0)), (ALONE, (1.0, 0.0))], ids=["nested", "alone"])
def test_the_likelihood_of_a_linear_model_is_exact(tmp_path: Path, text: str, spreads: tuple[float, float]) -> None:
    model, data, values = strains(tmp_path, text)
    made, u, weights = marginal_of(model, data)
    groups = made.likelihood.groups
    assert (groups.count, groups.size) == (STRAINS, SUBJECTS + 1)
    found = made.value(u, weights, np.zeros((groups.count, groups.size)))
    assert found.total == pytest.approx(exact(values, *spreads, 0.5), rel=1e-10)


@pytest.mark.parametrize("text", [NESTED, DECAYS], ids=["nested", "decays"])
def test_gradient_and_information_are_those_of_the_likelihood(tmp_path: Path, text: str) -> None:
    model, data, _ = strains(tmp_path, text)
    made, u, weights = marginal_of(model, data)
    along, h = np.random.default_rng(3).standard_normal(len(u)), 1e-4
    start = np.zeros((made.likelihood.groups.count, made.likelihood.groups.size))
    point = made.value(u, weights, start)
    found = made.slopes(u, weights, point.z)
    values = [made.value(u + s * h * along, weights, start).total for s in (-2, -1, 1, 2)]
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    assert found.parameters.sum(axis=0) @ along == pytest.approx(numeric, rel=1e-6, abs=1e-6)
    assert np.linalg.eigvalsh(made.information(u, weights, point.z)).min() > 0


@pytest.mark.parametrize("text", [NESTED, DECAYS], ids=["nested", "decays"])
def test_constants_follow_the_parameters_as_differences_say(tmp_path: Path, text: str) -> None:
    model, data, _ = strains(tmp_path, text)
    made, u, weights = marginal_of(model, data)
    assert_slopes_of_constants(made, u, weights, 2e-5)


def test_columns_that_cross_join_their_groups(tmp_path: Path) -> None:
    text = NESTED.replace("learn w", "learn v = 1 > 0 per site ~ lognormal\nlearn w").replace("x' = 0", "x' = 0*v")
    model, data, _ = strains(tmp_path, text, site=True)
    made, _, _ = marginal_of(model, data)
    groups = made.likelihood.groups
    assert (groups.count, groups.size) == (1, 2 * 24 + STRAINS + 3)
    z = torch.arange(groups.size, dtype=torch.float64)[None]
    numbers = groups.numbers(z).numpy()
    assert len(np.unique(numbers[:, 2])) == STRAINS
    assert len(np.unique(numbers[:, 3])) == 3
    assert groups.together(numbers) == pytest.approx(z.numpy())


def test_a_fit_finds_both_spreads(tmp_path: Path) -> None:
    model, data, values = strains(tmp_path, NESTED)
    run = train(model, data, TrainOptions(backend="torch", max_step=1.0, effort="low"), tmp_path / "run")
    found = run.fit.population
    assert found is not None
    of_subjects, of_strains = found.effects["m"], found.effects["m per strain"]
    assert (of_subjects.per, of_strains.per) == ("trajectory", "strain")
    centers = values.reshape(STRAINS, SUBJECTS, TIMES).mean(axis=2)
    within = ((values.reshape(-1, TIMES) - centers.reshape(-1, 1)) ** 2).sum() / (24 * (TIMES - 1))
    between = centers.var(axis=1, ddof=1).mean() - within / TIMES  # balanced: the likelihood's own estimates
    assert of_subjects.sd == pytest.approx(np.sqrt(between), rel=1e-3)
    strain = centers.mean(axis=1).var() - (between + within / TIMES) / SUBJECTS
    assert of_strains.sd == pytest.approx(np.sqrt(strain), rel=1e-3)
    assert of_strains.shrinkage is not None
    assert 0 < of_strains.shrinkage < 1
    none = {name: replace(one, shrinkage=-1e-4) for name, one in found.effects.items()}
    said = "\n".join(population_lines(replace(run, fit=replace(run.fit, population=replace(found, effects=none)))))
    assert " 0 %" in said and "-0 %" not in said
    logs = {name: replace(one, distribution="lognormal") for name, one in found.effects.items()}
    for effects, what in ((found.effects, "(mean)"), (logs, "(median)")):
        shown = replace(run, fit=replace(run.fit, population=replace(found, effects=effects)))
        (cell,) = (row[1] for row in report_tables.few_constants(shown).rows if row[0] == "m")
        assert cell.endswith(what)
    assert report_tables.distributed(run).rows[1][:2] == ("m per strain", "normal")
    assert [line for line in likelihood_lines(run) if line.startswith(f"-2 log likelihood {found.minus2ll:.4f}")]
    learned = models.learned(models.open_run(tmp_path / "run"))
    assert learned.individuals is not None
    assert learned.individuals.factor[0, 0] ** 2 == pytest.approx(of_subjects.sd**2 + of_strains.sd**2)


@pytest.mark.parametrize("text", [NESTED, ALONE], ids=["nested", "alone"])
def test_new_trajectories_of_known_groups_have_what_was_learned_of_them(tmp_path: Path, text: str) -> None:
    """Means and standard deviations of the linear mixed model: given the training data, and the first two rows."""
    model, data, values = strains(tmp_path, text)
    train(model, data, TrainOptions(backend="torch", max_step=1.0, effort="low"), tmp_path / "run")
    run = open_run(tmp_path / "run")
    effects = {name: one.sd for name, one in run.fit.population.effects.items()}  # type: ignore[union-attr]  # there
    between, within = effects["m per strain" if text == NESTED else "m"], effects["m"] if text == NESTED else 0.0
    noise, median = run.fit.noise["x"], run.fit.constants["m"].value
    level = float(values[:SUBJECTS].mean())  # of strain 1
    first = {"known": (1, (level - 0.1, level + 0.4)), "again": (1, ()), "new": (99, (5.2, 5.4)), "twin": (99, (5.3,))}
    cells = [f"{name},{t},{strain},{seen[t] if t < len(seen) else ''}" for name, (strain, seen) in first.items()
             for t in range(4)]  # fmt: skip
    (tmp_path / "new.csv").write_text("\n".join(["trajectory,t,strain,x", *cells]) + "\n")
    found = run_of(tmp_path / "run").predict(tmp_path / "new.csv", window=2)
    strain = np.repeat(1 + np.arange(STRAINS), SUBJECTS * TIMES)
    owner = np.repeat(np.arange(STRAINS * SUBJECTS), TIMES)
    for item, (mine, seen) in zip(found.items, first.values(), strict=True):
        groups = np.concatenate([strain, [mine] * (len(seen) + 1)])
        owners = np.concatenate([owner, [-1] * (len(seen) + 1)])
        joint = between**2 * (groups[:, None] == groups) + within**2 * (owners[:, None] == owners)
        joint = joint + noise**2 * np.eye(len(joint))
        weights = np.linalg.solve(joint[:-1, :-1], joint[:-1, -1])
        mean = median + weights @ (np.concatenate([values.ravel(), seen]) - median)
        trained = len(strain)
        of_median = 1 / np.linalg.solve(joint[:trained, :trained], np.ones(trained)).sum()
        variance = joint[-1, -1] - weights @ joint[:-1, -1] + (1 - weights.sum()) ** 2 * of_median
        assert item.mean[-1, 0] == pytest.approx(mean, rel=1e-6)
        assert 1 - 1e-6 < item.sd[-1, 0] / np.sqrt(variance) < 1.01  # spreads and noise are not known exactly either
    assert any(
        "several trajectories (`new`, `twin`) have the same value of `strain`" in said for said in found.warnings
    )
    member = run.member(0)
    new = table_of(tmp_path / "new.csv", model)
    predicted = [one for one in found.items if one.label != "again"]
    member.info["population"]["learned"]["of"] = []  # type: ignore[index]  # no group whose numbers were finite
    assert all("older version" not in said for said in said_of_groups(member, model, new.items, predicted))
    del member.info["population"]["learned"]  # type: ignore[attr-defined]  # as older versions have written it
    (said,) = said_of_groups(member, model, new.items, predicted)
    assert "older version" in said and "`strain` (`m`)" in said


def test_without_groups_each_trajectory_is_a_unit(tmp_path: Path) -> None:
    model, data, _ = strains(tmp_path, LEVEL)
    made, _, _ = marginal_of(model, data)
    groups: Groups = made.likelihood.groups
    assert (groups.count, groups.size, groups.shared) == (24, 1, False)


def test_what_is_not_offered_for_groups_is_said(tmp_path: Path) -> None:
    model, data, _ = strains(tmp_path, NESTED)
    options = TrainOptions(backend="torch", max_step=1.0, effort="low", quadrature=9)
    with pytest.raises(UserError) as caught:
        train(model, data, options, tmp_path / "run")
    assert [found.code for found in caught.value.diagnostics] == ["GB787"]


def test_trajectories_of_a_group_share_its_deviation(tmp_path: Path) -> None:
    """Strains differ by the standard deviation 2, their trajectories by 0.1, with the same strains in every table."""
    text = NESTED.replace("learn w = 0.8", "learn w = 2").replace("learn s = 1", "learn s = 0.1")
    model = model_of(text.replace("learn e = 0.5 > 0", "const e = 0.001"), tmp_path)
    subject = models.reference(model)
    options = SimulateOptions(trajectories=400, span=2.0, dt=1.0, condition={"strain": (1, 40)}, initial={})
    drawn = tables.simulate(subject, options)
    strain, level = (np.array([f(item) for item in drawn.items]) for f in (strain_of, level_of))
    assert set(strain) <= set(np.arange(1.0, 41.0))
    means = {which: level[strain == which].mean() for which in set(strain)}
    inside = level - np.array([means[which] for which in strain])
    assert np.std(inside) == pytest.approx(0.1, rel=0.15)
    assert np.std(list(means.values())) == pytest.approx(2.0, rel=0.35)
    again = tables.simulate(subject, SimulateOptions(trajectories=3, span=2.0, dt=1.0, condition={"strain": (7, 7)}))
    assert level_of(again.items[0]) == pytest.approx(means[7.0], abs=0.4)


def strain_of(item: Trajectory) -> float:
    return float(item.condition[0])


def level_of(item: Trajectory) -> float:
    return float(np.mean(item.values))


@pytest.mark.parametrize(
    ("text", "column", "said"),
    [
        (NESTED, "trajectory", "Leave `per trajectory` with its distribution out (`per strain` can stay)"),
        (NESTED, "strain", "Leave `per strain` with its distribution out (`per trajectory` can stay)"),
        (ALONE, "strain", "Leave the distribution out"),
        (LEVEL, "trajectory", "Leave the distribution out"),
    ],
)
def test_the_level_that_can_be_left_out_is_named(tmp_path: Path, text: str, column: str, said: str) -> None:
    (learnable,) = model_of(text, tmp_path).distributed
    assert left_out(learnable.distribution, column) == said
