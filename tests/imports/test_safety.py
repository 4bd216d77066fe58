"""Hostile XML is refused before a library reads it."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.diagnostics import UserError
from gbspec.imports import safety
from tests.imports import models as made


def reason(path: Path) -> str:
    with pytest.raises(UserError) as raised:
        safety.read_xml(path)
    (found,) = raised.value.diagnostics
    assert found.code == "GB894"
    return found.message


def test_a_model_is_read(tmp_path: Path) -> None:
    text = made.sbml(made.parameters(k="1"))
    assert safety.read_xml(made.stored(tmp_path, text))[0] == text.encode()


def test_entities_are_refused_however_they_are_declared(tmp_path: Path) -> None:
    bomb = '<?xml version="1.0"?><!DOCTYPE s [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]><s>&b;</s>'
    assert "document type" in reason(made.stored(tmp_path, bomb))
    outside = '<?xml version="1.0"?><!DOCTYPE s SYSTEM "http://127.0.0.1:9/x.dtd"><s/>'
    assert "document type" in reason(made.stored(tmp_path, outside))


@pytest.mark.parametrize("encoding", ["utf-16", "utf-7", "utf-32"])
def test_encodings_that_could_hide_something_are_refused(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "m.xml"
    path.write_bytes(f'<?xml version="1.0" encoding="{encoding}"?><s/>'.encode(encoding))
    assert "not UTF-8" in reason(path) or "is not read" in reason(path) or "encoding" in reason(path)


def test_depth_and_size_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = safety.DEEPEST + 1
    assert "deep" in reason(made.stored(tmp_path, "<a>" * deep + "</a>" * deep))
    monkeypatch.setattr(safety, "MOST_ELEMENTS", 10)
    assert "elements" in reason(made.stored(tmp_path, "<a>" + "<b/>" * 10 + "</a>"))
    path = tmp_path / "large.xml"
    with path.open("wb") as file:
        file.truncate(100_000_000)
    assert "larger than" in reason(path)


def test_a_text_that_is_no_xml_is_refused_with_its_line(tmp_path: Path) -> None:
    assert "well-formed" in reason(made.stored(tmp_path, "<a>\n<b></a>"))
