"""Reading files: encodings, line ends, and files that cannot be read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gbspec.diagnostics import Diagnostic, Findings, Span, UserError
from gbspec.syntax.parser import parse, read_source


def refused(path: Path) -> Diagnostic:
    with pytest.raises(UserError) as caught:
        read_source(path)
    (finding,) = caught.value.diagnostics
    return finding


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_byte_order_mark_and_line_ends(tmp_path: Path, mark: str, end: str) -> None:
    path = tmp_path / "m.gb"
    path.write_bytes((mark + f"model m{end}state größe{end}  in [0, 1]{end}").encode())
    source = read_source(path)
    assert source.text == "model m\nstate größe\n  in [0, 1]\n"
    findings = Findings()
    file = parse(source, findings)
    assert not list(findings)
    assert file is not None and len(file.statements) == 2


def test_an_absent_file_with_a_similar_one_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "fermenter.gb").write_text("model m\n")
    finding = refused(tmp_path / "fermentor.gb")
    assert finding.code == "GB001"
    assert "fermenter.gb" in finding.help
    assert refused(tmp_path / "nowhere" / "a.gb").help.startswith("the folder")


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    assert refused(tmp_path).code == "GB002"


def test_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    finding = refused(tmp_path / ("x" * 300))
    assert finding.code == "GB002"
    assert "cannot be read" in finding.message


def test_latin_1_has_its_place(tmp_path: Path) -> None:
    path = tmp_path / "m.gb"
    path.write_bytes("model m\nstate größe\n".encode("latin-1"))
    finding = refused(path)
    assert finding.code == "GB003"
    assert isinstance(finding.place, Span)
    assert finding.place.position[:2] == (2, 9)
    assert "0xF6" in finding.message


def test_utf_16_is_named(tmp_path: Path) -> None:
    path = tmp_path / "m.gb"
    path.write_bytes("model m\n".encode("utf-16"))
    assert "UTF-16" in refused(path).message


def test_a_binary_file_gives_diagnostics(tmp_path: Path) -> None:
    path = tmp_path / "m.gb"
    path.write_bytes(bytes(range(128)) * 50)
    findings = Findings()
    parse(read_source(path), findings)
    assert {"GB004"} <= {finding.code for finding in findings}


@pytest.mark.parametrize("name", ["data.csv", "DATA.TSV", "data.parquet"])
def test_a_table_in_place_of_the_model_is_one_diagnostic(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("t,x\n0,1\n1,2\n")
    with pytest.raises(UserError) as caught:
        read_source(tmp_path / name)
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB002"
    assert "table of data" in finding.message
    assert "`gbspec check` takes models only" in finding.help
    assert f"`gbspec train MODEL.gb {tmp_path / name} -o RUN`" in finding.help


@pytest.mark.parametrize("text", ["ID\tTime\tV\n16\t7.0\t96.25\n", "t;x\n0;1,5\n", "t,x\na,-1e3\n"])
def test_a_table_of_another_name_is_known_by_its_rows(tmp_path: Path, text: str) -> None:
    (tmp_path / "data.txt").write_text(text)
    with pytest.raises(UserError) as caught:
        read_source(tmp_path / "data.txt")
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB002"
    assert "saved as CSV" in finding.help and "`gbspec train MODEL.gb TABLE.csv -o RUN`" in finding.help


def test_a_model_may_have_any_other_name(tmp_path: Path) -> None:
    for text in ("model m\n", "# a, b\n# 1, 2\n", "model m\nstate x, y\n", "\n"):
        (tmp_path / "model.txt").write_text(text)
        assert read_source(tmp_path / "model.txt").text == text


def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    """A pipe without a writer would be waited for without end."""
    os.mkfifo(tmp_path / "m.gb")
    finding = refused(tmp_path / "m.gb")
    assert finding.code == "GB002"
    assert "pipe" in finding.message


def test_a_link_to_itself_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.gb").symlink_to(tmp_path / "m.gb")
    assert refused(tmp_path / "m.gb").code == "GB002"
