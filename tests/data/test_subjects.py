"""`per subject` beside a column of subjects that have several trajectories."""

from __future__ import annotations

import pytest

from tests.data.reader import Reader
from tests.texts import model_of

MODEL = "model m\nstate x\nlearn k = 1 in [0.1, 9] per subject ~ lognormal\nx' = -k*x\nobserve x\n"
SHARED = "trajectory,t,subject,x\ns1d1,0,1,5\ns1d1,1,1,3\ns1d2,0,1,5\ns1d2,1,1,2\ns2d1,0,2,5\ns2d1,1,2,1\n"
ALONE = SHARED.replace("s1d2,0,1", "s1d2,0,3").replace("s1d2,1,1", "s1d2,1,3")
LONG = "trajectory,t,subject,name,value\na,0,1,x,5\na,1,1,x,3\nb,0,1,x,5\nb,1,1,x,2\n"


@pytest.mark.parametrize("text", [SHARED, LONG])
def test_subjects_with_several_trajectories_are_told(reading: Reader, text: str) -> None:
    found, findings = reading(text, model_of(MODEL))
    (warning,) = findings
    assert found is not None
    assert warning.code == "GB711" and "`1` has 2 trajectories (" in warning.message
    assert "write `per person ~ lognormal`" in warning.help


def test_a_condition_of_that_name_is_not_looked_at_either(reading: Reader) -> None:
    _, (warning,) = reading(SHARED, model_of(MODEL + "condition subject\n"))
    assert "does not look at the column `subject`" in warning.message


def test_an_effect_per_subject_is_told_too(reading: Reader) -> None:
    text = "model m\nstate x\neffect e per subject\nx' = -exp(e)*x\nobserve x\n"
    _, (warning,) = reading(SHARED, model_of(text))
    assert "`per subject` means `per trajectory`" in warning.message


def test_subjects_that_are_trajectories_need_no_word(reading: Reader) -> None:
    assert reading(ALONE, model_of(MODEL))[1] == []


def test_models_without_the_word_have_an_unused_column(reading: Reader) -> None:
    _, (warning,) = reading(SHARED, model_of(MODEL.replace("per subject", "per trajectory")))
    assert "is not used" in warning.message
