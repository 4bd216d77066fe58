"""Whatever a model may be called, and whatever it may say, its generated module can be used."""

from __future__ import annotations

import pytest

from gbspec.backends.latex.equations import expression
from gbspec.backends.module import class_name, generate
from gbspec.ir import in_language
from gbspec.ir.model import unknown_function
from tests.texts import model_of

DECAY = "state x\nlearn k = 2\nx' = -k*x\nobserve x\n"


@pytest.mark.parametrize("character", ["\u2028", "\u2029", "\x85"])
def test_separators_of_lines_in_descriptions(character: str) -> None:
    text = f'model m "a{character}b"\n' + DECAY.replace("state x", f'state x "one{character}two"')
    compile(generate(model_of(text)), "m.py", "exec")


def test_a_state_named_like_a_constant_of_python() -> None:
    compile(generate(model_of("model m\n" + DECAY.replace("x", "__debug__"))), "m.py", "exec")


@pytest.mark.parametrize(("name", "expected"), [("value_error", "ValueError_"), ("type_error", "TypeError_")])
def test_a_class_hides_no_builtin(name: str, expected: str) -> None:
    assert class_name(model_of(f"model {name}\n" + DECAY)) == expected


def test_extrema_of_many_arguments() -> None:
    many = ", ".join(f"k*x + {i}" for i in range(300))
    compile(generate(model_of("model m\n" + DECAY.replace("-k*x", f"-min({many})"))), "m.py", "exec")


@pytest.mark.parametrize("name", ["Integer", "Rational", "Float", "Symbol", "Pow", "Add", "Mul", "Max", "Function"])
def test_unknowns_named_like_classes_of_sympy(name: str) -> None:
    x = unknown_function("x")(1)
    applied = unknown_function(name)(x) ** 2 * unknown_function(name)(3)
    assert name in expression(applied)
    assert in_language(applied > 1) == f"{name}(3)*{name}(x(1))^2 > 1"
