"""Models beyond a limit are refused with one diagnostic, and wrong ones near it with a limited number."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from gbspec.diagnostics import Findings, Source, UserError
from gbspec.frontend import load_model, read_source
from gbspec.semantics.arrays import LARGEST
from gbspec.syntax import format_text
from gbspec.syntax.limits import (
    LONGEST_WORD,
    MOST_BYTES,
    MOST_ERRORS,
    MOST_SIGNS,
    MOST_STATEMENTS,
    MOST_WRITTEN_OUT,
    too_large,
)
from tests.effort import calls

HEAD = "model m\nstate x = 1\nx' = -x\nobserve x\n"


def refusal(text: str) -> Findings:
    findings = Findings()
    with pytest.raises(UserError) as caught:
        load_model("m.gb", findings, lambda path: Source(str(path), text))
    findings.extend(caught.value.diagnostics)
    return findings


def codes(text: str) -> Counter[str]:
    return Counter(found.code for found in refusal(text))


def test_a_larger_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "m.gb"
    path.write_text("#" * (MOST_BYTES + 1))
    with pytest.raises(UserError) as caught:
        read_source(path)
    assert [found.code for found in caught.value.diagnostics] == ["GB010"]
    path.write_text("#" + " " * (MOST_BYTES - 1))
    assert too_large(read_source(path)) is None


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "let a = " + "1+" * (MOST_SIGNS // 2) + "1\n",
        HEAD + "let " + "a" * (LONGEST_WORD + 1) + " = 1\n",
        HEAD + "let a = " + "9" * (LONGEST_WORD + 1) + "\n",
        "(" * (MOST_SIGNS + 1),
        HEAD + "#" * (MOST_BYTES + 1),
    ],
    ids=["signs", "word", "number", "brackets", "bytes"],
)
def test_a_text_beyond_a_limit_gets_one_error(text: str) -> None:
    assert codes(text) == {"GB010": 1}
    with pytest.raises(UserError) as caught:
        format_text(Source("m.gb", text))
    assert [found.code for found in caught.value.diagnostics] == ["GB010"]


def test_too_many_statements_get_one_error() -> None:
    assert codes(HEAD + "let a = 1\n" * (MOST_STATEMENTS - 3)) == {"GB010": 1}


def test_too_many_elements_of_arrays_get_one_error() -> None:
    arrays = "".join(f"state x{n}[1..{LARGEST}] = 1\n" for n in range(MOST_WRITTEN_OUT // LARGEST + 1))
    assert codes("model m\n" + arrays) == {"GB010": 1}


def test_long_balances_of_arrays_get_one_error() -> None:
    text = f"model m\nstate x[1..{LARGEST}] = 1\nx[i]' = " + "-x[i]" * 300 + "\n"
    assert codes(text) == {"GB010": 1}


def test_sums_of_all_elements_in_every_balance_get_one_error() -> None:
    assert codes(f"model m\nstate x[1..{LARGEST}] = 1\nx[i]' = -sum(x)\nobserve x[1]\n") == {"GB010": 1}


def test_what_is_extended_counts() -> None:
    half = "let a = " + "1+" * (MOST_SIGNS // 4) + "1\n"
    texts = {"m.gb": 'model m extends "b.gb"\n' + half, "b.gb": HEAD + half}
    with pytest.raises(UserError) as caught:
        load_model("m.gb", Findings(), lambda path: Source(Path(path).name, texts[Path(path).name]))
    assert [found.code for found in caught.value.diagnostics] == ["GB010"]


def test_a_file_is_not_read_on_after_many_errors() -> None:
    found = refusal("asdf qwer ?? 17\n" * (MOST_ERRORS + 700))
    assert Counter(one.code for one in found)["GB011"] == 1
    assert len(found) == MOST_ERRORS + 1
    (last,) = [one for one in found if one.code == "GB011"]
    assert "700 more lines" in last.message
    assert list(found)[-1] is last


def test_the_lines_that_are_not_read_may_declare_anything() -> None:
    text = HEAD + "let a = b\n" + "asdf qwer ?? 17\n" * MOST_ERRORS + "let b = 1\n"
    assert set(codes(text)) == {"GB125", "GB011"}


def test_undeclared_names_are_reported_up_to_a_number() -> None:
    found = refusal(HEAD + "let a = " + " + ".join(f"nothing{i}" for i in range(1000)) + "\n")
    assert [one.code for one in found] == ["GB201"] * 200
    assert any("800 more names" in note for one in found for note in one.notes)


def test_the_work_for_undeclared_names_grows_with_their_number() -> None:
    def work(count: int) -> int:
        return calls(lambda: refusal(HEAD + "".join(f"let a{i} = nothing{i}\n" for i in range(count))))

    base = work(250)  # more than are reported, so that suggestions cost the same
    assert work(1000) - base < 6 * base


def test_a_chain_of_constants_in_reverse_takes_linear_work() -> None:
    def work(count: int) -> int:
        chain = "".join(f"const a{i} = a{i + 1}\n" for i in range(count))
        text = f"model m\n{chain}const a{count} = 2\nstate x[1..a0] = 1\nx[i]' = -x[i]\nobserve x[1]\n"
        return calls(lambda: load_model("m.gb", Findings(), lambda path: Source(str(path), text)))

    work(10)
    assert work(400) < 6 * work(100)


def test_a_sum_of_many_constants_takes_linear_work() -> None:
    def work(count: int) -> int:
        terms = " + ".join(f"a{i}" for i in range(count))
        constants = "".join(f"const a{i} = 1\n" for i in range(count))
        text = f"model m\nconst n = {terms}\n{constants}state x[1..n] = 1\nx[1]' = 0\nobserve x[1]\n"
        return calls(lambda: refusal(text))

    work(10)
    assert work(400) < 6 * work(100)


def test_constants_of_an_if_with_a_wrong_branch_give_the_size_of_an_array() -> None:
    text = "model m\nconst n = if(2 > k, 3, m)\nconst m = m\nconst k = 1\nstate x[1..n] = 1\nx[i]' = 0\nobserve x[1]\n"
    assert codes(text) == {"GB208": 1}
