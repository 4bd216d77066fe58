"""The LaTeX document: names, balanced text, and equations that a renderer of LaTeX's mathematics accepts."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import sympy
from matplotlib.mathtext import MathTextParser

from gbspec.backends.latex import document, expression, name
from gbspec.backends.latex.page import text
from gbspec.backends.registry import backends
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.ir.model import symbol, unknown_function
from tests.backends.examples import clinic

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ("x", "x"),
        ("x1", "x_{1}"),
        ("K_m", "K_{m}"),
        ("mu_max", r"\mu_{\mathrm{max}}"),
        ("μ", r"\mu"),
        ("Ω_2", r"\Omega_{2}"),
        ("λ", r"\lambda"),
        ("lambda", r"\lambda"),
        ("Da", r"\mathrm{Da}"),
        ("host_growth", r"\mathrm{host\_growth}"),
        ("_", r"\mathrm{\_}"),
    ],
)
def test_names(given: str, wanted: str) -> None:
    assert name(given) == wanted


def test_expressions() -> None:
    x, k = symbol("x"), symbol("k_1")
    assert expression(unknown_function("phi")(x) ** 2) == r"\phi^{2}\left(x\right)"
    assert expression(sympy.Float(2.5e-7) * x) == r"2.5 \cdot 10^{-7} \, x"
    assert expression(sympy.Float(0.1) + x) == "x + 0.1"
    assert expression(x / (k + x)) == r"\frac{x}{k_{1} + x}"


def test_words_keep_their_characters() -> None:
    assert text("50 % of A_1 & B\n# {x} \\ ~^$") == (
        r"50 \% of A\_1 \& B \# \{x\} \textbackslash{} \textasciitilde{}\textasciicircum{}\$"
    )


def test_golden() -> None:
    path, found = GOLDEN / "latex_clinic.tex", document(clinic())
    if os.environ.get("UPDATE_GOLDEN"):
        path.write_text(found, encoding="utf-8")
    assert found == path.read_text(encoding="utf-8")


@pytest.mark.parametrize("model", sorted(shipped_models()))
def test_bundled_models_are_well_formed(model: str) -> None:
    page = document(load_model(shipped_models()[model], Findings()))
    assert page == backends()["latex"].emit(load_model(shipped_models()[model], Findings()))
    bare = re.sub(r"\\[{}]", "", page)
    assert bare.count("{") == bare.count("}")
    assert page.count(r"\begin{") == page.count(r"\end{")
    parser = MathTextParser("agg")
    lines = [
        line
        for block in re.findall(r"\\begin\{align\*\}\n(.*?)\n\\end", page, flags=re.S)
        for line in block.split("\\\\\n")
    ]
    assert lines
    for line in lines:
        if r"\begin" not in line:  # matplotlib does not support cases
            parser.parse(f"${line.replace('&', '').strip()}$")


def test_events_have_their_conditions_and_times() -> None:
    page = document(load_model(shipped_models()["bouncing_ball"], Findings()))
    (block,) = re.findall(r"subsection\*\{Events\}\n(.*?)\\end\{align\*\}", page, flags=re.S)
    assert r"\Rightarrow" in block
    assert ":=" in block
