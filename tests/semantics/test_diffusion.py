"""The statement `diffusion`: what is read, checked and kept in the Model."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.diagnostics import Findings, UserError
from gbspec.frontend import load_model
from gbspec.ir import Model, dump
from gbspec.passes import examine

HEAD = "model m\ntime t : h\nconst tau : h = 3\nstate x : K = 1\ninput u : K held\nlearn s : K/h^0.5 = 0.1 in [0, 1]\n"


def read(tmp_path: Path, text: str) -> Model:
    path = tmp_path / "m.gb"
    path.write_text(text, encoding="utf-8")
    return load_model(path, Findings())


def test_an_additive_disturbance_is_kept_as_it_is(tmp_path: Path) -> None:
    model = read(tmp_path, HEAD + "x' = (u - x)/tau\ndiffusion x = 2*s\nobserve x\n")
    assert [(d.state, str(d.value), d.relative) for d in model.diffusions] == [("x", "2*s", None)]
    assert "x by 2*s" in dump(model)


def test_a_disturbance_proportional_to_its_state_is_one_of_the_logarithm(tmp_path: Path) -> None:
    text = "model m\nstate x = 1\ncondition c\nlearn s = 1\nlet size = s*c\nx' = -x\ndiffusion x = size*x/2\n"
    found = read(tmp_path, text + "observe x\n").diffusions[0]
    assert found.relative is not None
    assert str(found.relative) == "c*s/2"


def test_the_unit_is_that_of_the_state_per_root_of_time(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path, HEAD + "const a : K = 1\nx' = (u - x)/tau\ndiffusion x = a\nobserve x\n")
    assert [d.code for d in caught.value.diagnostics if d.code != "GB403"] == ["GB504"]


@pytest.mark.parametrize("statement", ["diffusion' = -diffusion\nobserve diffusion", "diffusion[1] = 2"])
def test_the_word_stays_a_name_where_it_was_one(tmp_path: Path, statement: str) -> None:
    array = "[1]" in statement
    text = "model m\nstate diffusion[2..3]\ndiffusion[i]' = diffusion[i-1] - diffusion[i]\nobserve diffusion\n"
    given = text + statement + "\n" if array else f"model m\nstate diffusion = 1\n{statement}\n"
    assert read(tmp_path, given).states[0].name.startswith("diffusion")


def test_identifiability_is_undecided_where_only_a_disturbance_tells(tmp_path: Path) -> None:
    text = "model m\nstate x = 1\nstate h = 1\nlearn a = 1\nlearn s = 1\nx' = a*h - x\nh' = -h\ndiffusion h = 0.2\n"
    found = examine(read(tmp_path, text + "diffusion x = s\nobserve x\n"), findings := Findings())
    assert not found.identifiability.decided
    assert not found.identifiability.sets
    assert not list(findings)


def test_what_the_drift_alone_cannot_tell_apart_is_still_reported(tmp_path: Path) -> None:
    text = "model m\nstate x = 1\nlearn a = 1\nlearn b = 1\nlearn s = 1\nx' = -(a + b)*x\ndiffusion x = s\nobserve x\n"
    examine(read(tmp_path, text), findings := Findings())
    assert [d.code for d in findings] == ["GB401"]
