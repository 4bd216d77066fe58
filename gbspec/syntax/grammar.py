"""The grammar's files, in a checkout or in an installed package, and the parser made from them."""

from __future__ import annotations

import os
import sys
import threading
from functools import cache
from pathlib import Path

from lark import Lark

from gbspec.diagnostics import Defect
from gbspec.syntax.transformer import Builder

_PACKAGE = Path(__file__).resolve().parent.parent
_FOLDERS = (_PACKAGE / "_grammar", _PACKAGE.parent / "grammar")
_local = threading.local()


@cache
def grammar_file(name: str) -> Path:
    """The path of a file of the grammar (`gb.lark`, `mistakes.toml`); raises `Defect` if it is not installed."""
    for folder in _FOLDERS:
        if (folder / name).is_file():
            return folder / name
    raise Defect(f"the installation lacks the grammar file {name}")


@cache
def _table_file() -> str | bool:
    """The file that caches the parser's table, which saves 0.2 s per start; False if it cannot be written.

    lark records the grammar and the versions of lark and Python in it, and rebuilds the table when they differ.
    """
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA", "")
    else:
        base = os.environ.get("XDG_CACHE_HOME", "") or os.path.expanduser("~/.cache")
    folder = Path(base) / "gbspec"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return False
    return str(folder / "grammar.table") if base and os.access(folder, os.W_OK) else False


def engine() -> tuple[Lark, Builder]:
    """This thread's parser and the builder of nodes inside it (which has state, hence one per thread)."""
    if not hasattr(_local, "engine"):
        builder = Builder()
        text = grammar_file("gb.lark").read_text(encoding="utf-8")
        lark = Lark(
            text,
            parser="lalr",
            lexer="contextual",
            start=["statement", "expression", "slip"],
            keep_all_tokens=True,
            maybe_placeholders=False,
            transformer=builder,
            cache=_table_file(),
        )
        _local.engine = lark, builder
    engine: tuple[Lark, Builder] = _local.engine
    return engine
