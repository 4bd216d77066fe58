"""Highlighting of `.gb` in the pages, from the words that editors highlight."""

from __future__ import annotations

from typing import ClassVar

from pygments.lexer import RegexLexer, words
from pygments.token import Comment, Keyword, Name, Number, Operator, Punctuation, String, Text

from gbspec.lsp.words import DISTRIBUTIONS, FUNCTIONS, NETWORKS
from gbspec.syntax.ast import WORDS

CLAUSES = ("in", "by", "as", "prior", "per", "trajectory", "held", "linear", "from", "rate", "noise", "zero", "at")
MORE = ("increasing", "decreasing", "extends", "times", "lag", "and", "or", "not", "if", "nn", "pi")


class GbLexer(RegexLexer):  # type: ignore[misc]  # Pygments has no types
    """Statements at the start of a line, clauses, functions, numbers, strings and comments."""

    name = "gb"
    aliases: ClassVar = ["gb"]
    filenames: ClassVar = ["*.gb"]
    tokens: ClassVar = {
        "root": [
            (r"#.*$", Comment.Single),
            (r'"[^"\n]*"', String),
            (words(tuple(WORDS), prefix=r"^", suffix=r"\b"), Keyword),
            (words(CLAUSES + MORE, prefix=r"\b", suffix=r"\b"), Keyword.Pseudo),
            (words((*FUNCTIONS, *NETWORKS, *DISTRIBUTIONS, "net"), prefix=r"\b", suffix=r"(?=\()"), Name.Builtin),
            (r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", Number),
            (r"[^\W\d]\w*", Name),
            (r"[-+*/^=<>'|~:.]+", Operator),
            (r"[()\[\],]", Punctuation),
            (r"\s+", Text),
            (r".", Text),
        ]
    }
