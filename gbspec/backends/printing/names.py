"""Identifiers for the names of a model: safe in the target language, distinct, and close to the user's."""

from __future__ import annotations

import keyword
import unicodedata
from collections.abc import Iterable

import sympy

PYTHON_WORDS = frozenset({*keyword.kwlist, "cls", "self", "__debug__", "_lookup"})
"""Names that quantities of the model never have in generated Python."""


def identifier(name: str) -> str:
    """The Python identifier nearest to a name: NFKC, with every invalid character replaced by `_`."""
    text = "".join(c if f"_{c}".isidentifier() else "_" for c in unicodedata.normalize("NFKC", name))
    return text if text.isidentifier() else f"_{text}"


def docstring(text: str) -> str:
    """A text as a Python docstring; backslashes and quotes in it are escaped."""
    safe = text.replace("\\", "\\\\").replace('"""', '\\"\\"\\"')
    if "\n" in safe:
        return f'"""{safe}\n"""'
    return f'"""{safe[:-1]}\\""""' if safe.endswith('"') else f'"""{safe}"""'


class Names:
    """The identifiers of one scope, one per symbol; underscores are appended to a name that is taken or reserved.

    Symbols are the keys, so that a temporary (a `sympy.Dummy`) never shares the identifier of a quantity of that name.
    """

    def __init__(self, reserved: Iterable[str] = ()) -> None:
        self._taken = {*PYTHON_WORDS, *reserved}
        self._of: dict[sympy.Symbol, str] = {}

    def claim(self, symbol: sympy.Symbol, wish: str | None = None) -> str:
        """The identifier of a symbol, created unless it has one; `wish` is the preferred name."""
        if symbol not in self._of:
            name = identifier(wish if wish is not None else symbol.name)
            while name in self._taken:
                name += "_"
            self._taken.add(name)
            self._of[symbol] = name
        return self._of[symbol]

    def fix(self, symbol: sympy.Symbol, name: str) -> None:
        """Gives a symbol a reserved name."""
        self._of[symbol] = name

    def copy(self) -> Names:
        """An independent copy."""
        other = Names()
        other._taken, other._of = set(self._taken), dict(self._of)
        return other

    def __getitem__(self, symbol: sympy.Symbol) -> str:
        return self._of[symbol]

    def __contains__(self, symbol: sympy.Symbol) -> bool:
        return symbol in self._of
