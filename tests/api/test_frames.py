"""Data frames go into the Python interface and come out of it; results are short on a prompt, tables in a notebook."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import polars as pl
import pytest

import gbspec
from gbspec.data import SimulateOptions, Trajectories
from gbspec.frames import counted
from gbspec.keywords import SimulateKeywords, StudyKeywords, TrainKeywords
from gbspec.report.progress import Lines, Notebook, progress_of
from gbspec.studies import StudyOptions
from gbspec.training import Silent, TrainOptions, Update


@pytest.fixture(scope="module")
def data(model: gbspec.Specification) -> Trajectories:
    return model.simulate(trajectories=4, span=4.0, dt=0.5, noise=0.01, keep_start=True)


@pytest.fixture(scope="module")
def run(
    model: gbspec.Specification, data: Trajectories, tmp_path_factory: pytest.TempPathFactory, quick_fits: None
) -> gbspec.FittedRun:
    frame = data.to_frame()
    return model.train(frame, tmp_path_factory.mktemp("run") / "fit", effort="low", max_step=0.5)


# ---------------------------------------------------------------------- in
class Pandas:
    """What of a data frame of pandas is used; pandas itself is not among the packages of the tests."""

    class Column:
        def __init__(self, values: pl.Series) -> None:
            self.values = values

        def to_numpy(self) -> np.ndarray[Any, Any]:
            return np.array(self.values.to_list(), dtype=object)

    def __init__(self, frame: pl.DataFrame) -> None:
        self.frame, self.columns = frame, frame.columns

    def __getitem__(self, name: str) -> Pandas.Column:
        return Pandas.Column(self.frame[name])


FORMS: dict[str, Callable[[pl.DataFrame], object]] = {
    "polars": lambda frame: frame,
    "lazy": lambda frame: frame.lazy(),
    "arrow": lambda frame: frame.to_arrow(),
    "arrays": lambda frame: {name: frame[name].to_numpy() for name in frame.columns},
    "lists": lambda frame: frame.to_dict(as_series=False),
    "pandas": Pandas,
}


class Missing:
    """pandas.NA: what it is compared with is missing too, and has no truth value."""

    def __ne__(self, other: object) -> Missing:  # type: ignore[override]
        return self

    def __bool__(self) -> bool:
        raise TypeError("boolean value of NA is ambiguous")

    def __repr__(self) -> str:
        return "<NA>"


def test_missing_values_of_pandas_are_empty_cells() -> None:
    from gbspec.data import frame_columns

    columns = frame_columns({"x": np.array([1.5, Missing(), None, float("nan"), 2], dtype=object)})
    np.testing.assert_array_equal(columns["x"], [1.5, np.nan, np.nan, np.nan, 2.0])


@pytest.mark.parametrize("form", FORMS)
def test_a_table_in_memory_gives_the_same_trajectories(
    model: gbspec.Specification, data: Trajectories, form: str, tmp_path: Path
) -> None:
    from gbspec.data import content_digest

    given = FORMS[form](data.to_frame())
    found = gbspec.fitted.table_of(given, model.model)
    assert content_digest(found) == content_digest(data)
    assert (found.path, found.sha256) == ("", content_digest(data))
    assert model.simulate(like=given).measurements == data.measurements


def test_pandas_itself(model: gbspec.Specification, data: Trajectories) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    frame = pandas.DataFrame(data.to_frame().to_dict(as_series=False))
    assert gbspec.fitted.table_of(frame, model.model).measurements == data.measurements


def test_tensors_and_missing_values(model: gbspec.Specification) -> None:
    import torch

    columns = {"t": torch.tensor([0.0, 1.0, 2.0]), "x": [1.0, None, 0.5], "T": np.full(3, 300)}
    found = gbspec.fitted.table_of(columns, model.model)
    assert found.items[0].times.tolist() == [0.0, 2.0]


@pytest.mark.parametrize(
    ("columns", "code", "message"),
    [
        ({"t": [0.0, 1.0], "x": [1.0], "T": [1.0, 1.0]}, "GB708", "column `x` has 1 values, column `t` has 2"),
        ({}, "GB704", "empty"),
        ({"t": [0.0, 1.0], "x": ["a", "b"], "T": [300.0, 300.0]}, "GB712", "row 0"),
        ({"t": [0.0, 1.0], "y": [1.0, 2.0], "T": [300.0, 300.0]}, "GB710", "no column `x`"),
        ({"t": np.array(["2020-01-01", "2020-01-02"], dtype="datetime64[D]"), "x": [1.0, 2.0]}, "GB730", "t"),
    ],
)
def test_what_is_wrong_in_a_table_in_memory_is_told(
    model: gbspec.Specification, columns: dict[str, Any], code: str, message: str
) -> None:
    with pytest.raises(gbspec.UserError) as caught:
        gbspec.fitted.table_of(columns, model.model)
    found = [d for d in caught.value.diagnostics if d.code == code]
    assert found, [d.code for d in caught.value.diagnostics]
    assert message in str(found[0].message) + str(found[0].place)


def test_what_is_no_table_is_refused(model: gbspec.Specification, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="not int"):
        model.train(3, tmp_path / "run")


# ---------------------------------------------------------------------- out
def test_simulated_data_are_a_table(data: Trajectories) -> None:
    frame = data.to_frame()
    assert frame.columns == ["trajectory", "t", "x", "T"]
    assert frame.height == sum(len(item.times) for item in data.items)
    assert data.subset([1]).to_frame()["trajectory"].unique().to_list() == [data.items[1].label]


def test_what_a_run_learned_is_a_frame(run: gbspec.FittedRun) -> None:
    frame = run.to_frame()
    (row,) = frame.to_dicts()
    assert (row["constant"], row["unit"], row["start"]) == ("k", "1/h", 0.3)
    assert row["low"] < row["value"] < row["high"]
    assert run.history()["k"].len() > 0


def test_results_of_a_run_are_frames(run: gbspec.FittedRun, data: Trajectories) -> None:
    validation = run.validate()
    assert validation.to_frame()["channel"].to_list() == ["x"]
    forecast = run.predict(data.to_frame(), window=2)
    assert forecast.to_frame().columns == ["trajectory", "t", "x", "x_low", "x_high", "used", "outside"]
    eigen = run.eigen(at=[{"x": 1.0, "T": 300.0}])
    assert str(run.eigen(at={"x": 1.0, "T": 300.0})) == str(eigen)
    assert eigen.to_frame()["real"][0] == pytest.approx(-run.constants["k"])
    for result in (run, validation, forecast, eigen, data):
        assert len(repr(result)) < 300
        assert "\n" not in repr(result)
        shown = result._repr_html_()
        assert shown.startswith("<table>")
        assert shown.count("<table") == shown.count("</table>") == 1


def test_a_fit_goes_on_with_the_same_data_in_memory_only(run: gbspec.FittedRun, data: Trajectories) -> None:
    for given in (data, data.to_frame()):  # the fit has moved the starts, which are measured with noise
        assert len(run.initial_states(given).items) == 4
    with pytest.raises(gbspec.UserError) as caught:
        run.initial_states(data.subset([0]))
    assert [d.code for d in caught.value.diagnostics] == ["GB859"]


def test_a_model_shows_what_it_declares(model: gbspec.Specification) -> None:
    frame = model.to_frame()
    assert frame["role"].to_list() == ["time", "state", "condition", "learned", "channel"]
    assert frame.row(by_predicate=pl.col("name") == "k", named=True)["unit"] == "1/h"
    assert repr(model) == "<Specification: decay: Decay of a substance>"
    assert "Decay of a substance" in model._repr_html_()


def test_texts_of_users_are_escaped_in_html(data: Trajectories) -> None:
    from gbspec.frames import html

    frame = pl.DataFrame({"<b>": ["<script>"] * 30})
    shown = html(frame, "a & b", ["<i>"])
    assert "<script>" not in shown
    assert "<b>" not in shown
    assert "10 more rows" in shown


def test_a_learned_function_is_a_frame(tmp_path: Path, quick_fit: None) -> None:
    path = tmp_path / "growth.gb"
    text = "model growth\nstate x in [0, 2]\nunknown f(x) by mlp(4)\ntruth f(x) = -x\nx' = f(x)\nobserve x\n"
    path.write_text(text, encoding="utf-8")
    model = gbspec.load(path)
    made = model.train(model.simulate(trajectories=3, span=2.0, dt=0.5), tmp_path / "run", effort="low", max_step=0.5)
    frame = made.function("f", {"x": [0.2, 0.4]})
    assert frame.columns == ["x", "value", "low", "high"]
    member = made.member()
    assert frame["value"].to_list() == pytest.approx(member.functions["f"]([[0.2], [0.4]]).tolist())
    for points in ([[0.2], [0.4]], [0.2, 0.4], np.array([[0.2], [0.4]])):
        assert made.function("f", points).equals(frame)
    with pytest.raises(ValueError, match=r"a table with columns x, or numbers \[points, 1\], not \[1, 2\]"):
        made.function("f", [[0.2, 0.4]])
    for wrong in ("points.csv", None, [[0.2], [0.4, 0.5]]):
        with pytest.raises(ValueError, match="the points of `f` are a table"):
            made.function("f", wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no column of numbers is named x"):
        made.function("f", {"y": [0.2]})
    with pytest.raises(ValueError, match="there is no function `g`"):
        made.function("g", {"x": [0.2]})


# ---------------------------------------------------------------------- options
@pytest.mark.parametrize(
    ("keywords", "options", "functions"),
    [
        (
            TrainKeywords,
            TrainOptions,
            [gbspec.train, gbspec.Specification.train, gbspec.Specification.crossvalidate],
        ),
        (
            SimulateKeywords,
            SimulateOptions,
            [gbspec.simulate, gbspec.Specification.simulate, gbspec.FittedRun.simulate],
        ),
        (StudyKeywords, StudyOptions, [gbspec.study]),
    ],
)
def test_keyword_arguments_are_the_options(keywords: Any, options: Any, functions: list[Callable[..., Any]]) -> None:
    wanted = typing.get_type_hints(options)
    fields = {name: wanted[name] for name in options.__dataclass_fields__}
    assert typing.get_type_hints(keywords) == fields
    for function in functions:
        parameters = inspect.signature(function).parameters
        assert set(fields) <= set(parameters)
        assert not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
        for name, field in options.__dataclass_fields__.items():
            assert str(field.metadata.get("help", "")) in (function.__doc__ or ""), name


PUBLIC = [
    *(getattr(gbspec, name) for name in gbspec.__all__ if inspect.isfunction(getattr(gbspec, name))),
    *(
        method
        for owner in (gbspec.Specification, gbspec.FittedRun)
        for name, method in inspect.getmembers(owner, inspect.isfunction)
        if not name.startswith("_") and len(inspect.signature(method).parameters) > 1
    ),
]


@pytest.mark.parametrize("function", PUBLIC, ids=lambda function: str(function.__qualname__))
def test_a_misspelt_name_is_answered_with_the_nearest_by_every_call(function: Callable[..., Any]) -> None:
    for name in inspect.signature(function).parameters:
        if name == "self":
            continue
        wrong = name.rstrip("_")[:-1] + "x" if len(name) > 4 else name + "x"
        with pytest.raises(TypeError) as caught:
            function(**{wrong: 1})
        assert str(caught.value).startswith(f"{function.__name__}() has no option `{wrong}`; did you mean `"), name


def test_the_nearest_name_is_the_one_that_was_meant(model: gbspec.Specification, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"^train\(\) has no option `efort`; did you mean `effort`\?$"):
        cast(Any, model.train)({"t": [0.0]}, tmp_path / "run", efort="low")
    with pytest.raises(TypeError, match=r"^eigen\(\) has no option `allong`; did you mean `along`\?$"):
        cast(Any, model.eigen)(allong={"t": [0.0]})
    with pytest.raises(TypeError, match=r"^validate\(\) has no option `zzz`; it has run, data$"):
        cast(Any, gbspec.validate)("run", zzz=1)
    with pytest.raises(TypeError, match=r"^check\(\) has no option `self`; it has none$"):
        cast(Any, gbspec.Specification.check)(self=model)


def test_errors_are_public() -> None:
    with pytest.raises(gbspec.UserError) as caught:
        gbspec.load("there_is_no_such_model.gb")
    assert isinstance(caught.value.diagnostics[0], gbspec.Diagnostic)
    assert issubclass(gbspec.ComputationError, Exception)


# ---------------------------------------------------------------------- progress
UPDATE = Update(0, "warm start", 3, 60, 0.25, 1.0, 125.0, {"k": 0.5})


def test_progress_in_a_notebook_is_a_table_that_is_redrawn() -> None:
    drawn: list[str] = []

    class Handle:
        def update(self, shown: Any) -> None:
            drawn.append(shown._repr_html_())

    def display(shown: object, *, display_id: bool) -> Handle:
        assert display_id
        return Handle()

    notebook = Notebook(display)
    notebook.message("preparing <b>")
    assert "preparing &lt;b&gt;" in drawn[-1]
    notebook.drawn = 0.0
    notebook.update(UPDATE)
    assert "<td>warm start</td>" in drawn[-1]
    assert "left, about" in drawn[-1]
    assert "2 min 05 s" in drawn[-1]


def test_where_progress_is_shown(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with progress_of(None) as shown:
        assert isinstance(shown, Silent)
    with progress_of(True) as shown:
        assert isinstance(shown, Lines)
        shown.update(UPDATE)
    assert "about 2 min 05 s left" in capsys.readouterr().err
    handles: list[object] = []
    shell = types.SimpleNamespace(kernel=object())
    monkeypatch.setitem(__import__("sys").modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
    display = types.SimpleNamespace(
        display=lambda shown, display_id: types.SimpleNamespace(update=lambda again: handles.append(again))
    )
    monkeypatch.setitem(__import__("sys").modules, "IPython.display", display)
    with progress_of(None) as shown:
        assert isinstance(shown, Notebook)
    assert handles
    with progress_of(False) as shown:
        assert isinstance(shown, Silent)


def test_preparation_is_told_before_the_first_iteration(
    model: gbspec.Specification, data: Trajectories, tmp_path: Path, quick_fit: None
) -> None:
    events: list[str] = []

    class Kept:
        def update(self, update: Update) -> None:
            events.append("update")

        def message(self, text: str) -> None:
            events.append(text)

    model.train(data, tmp_path / "run", effort="low", max_step=0.5, progress=Kept())
    first = events.index("update")
    assert events[0] == "preparing: decay, 36 values in 4 trajectories"
    assert any("member 0" in text for text in events[:first])


def test_numbers_have_the_right_plural() -> None:
    assert [counted(n, "row") for n in (0, 1, 1200)] == ["0 rows", "1 row", "1,200 rows"]
    assert [counted(n, "trajectory") for n in (1, 2)] == ["1 trajectory", "2 trajectories"]
    assert counted(2, "point is", "points are") == "2 points are"
