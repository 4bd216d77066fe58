"""Turns a parser error into a diagnostic: the table of likely mistakes, else what was expected.

The table is grammar/mistakes.toml. An entry gives malformed snippets. Each is parsed once; the parser's top state and
the offending terminal at which it stops are the key of the entry. (lark's own `match_examples` compares whole stacks,
which depend on the preceding text.) An entry may also name terminals that are a mistake in any state, and select by
patterns among several entries for one key.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache, cached_property
from weakref import WeakKeyDictionary

from lark import Lark, Token
from lark.exceptions import UnexpectedInput, UnexpectedToken

from gbspec.diagnostics import Diagnostic, Label, Span
from gbspec.json_values import JsonObject
from gbspec.syntax.ast import WORDS
from gbspec.syntax.chunks import Chunk
from gbspec.syntax.grammar import grammar_file
from gbspec.syntax.names import normalise

_WORD = re.compile(r"[^\W\d]\w*")
_LAST = re.compile(r'("[^"\n]*"|\w+(?:\.\w+)*|[^\w\s])\s*\Z')
_WINDOW = 500  # how many characters before the offending token, and at the statement's beginning, patterns see
_OPERAND = frozenset({"NAME", "NUMBER", "PLUS", "MINUS", "LPAR"})
_KEYWORDS = frozenset(
    {
        *WORDS,
        *(
            "extends",
            "from",
            "in",
            "as",
            "held",
            "linear",
            "prior",
            "noise",
            "per",
            "trajectory",
            "rate",
            "over",
            "times",
            "lag",
        ),
        *("when", "every", "until", "after", "queue", "priority", "transient", "sampled", "armed"),
        *("convex", "concave", "odd", "even", "period", "equals", "steady", "with", "then"),
        *("by", "zero", "at", "increasing", "decreasing", "if", "and", "or", "not"),
    }
)
_BRACKETS = {"(": ")", "[": "]", "{": "}"}


@dataclass(frozen=True)
class Mistake:
    """An entry of the table: when it fits, and what it says.

    `snippets` and `terminals` say where the parser stops (either; neither: anywhere); `statement`, `before` and `found`
    are patterns for the whole statement, for the text before the offending token and for the text from it on;
    `word` says what the statement's first word is (`state`: a declared state; `slip`: a misspelt keyword or a synonym
    of one; else that word itself), `meant` that the offending word is a misspelt keyword, `unit` that it is the name of
    a unit, and `open` that a bracket is open. `at` is the place of the diagnostic: `found`, `before` (the one before),
    `after` (the point after it), `both`, `word`, `statement`, or the name of a group of a pattern.
    """

    code: str
    message: str
    help: str = ""
    snippets: tuple[str, ...] = ()
    terminals: tuple[str, ...] = ()
    statement: str = ""
    before: str = ""
    found: str = ""
    word: str = ""
    meant: bool = False
    unit: bool = False
    state: str = ""
    open: bool = False
    closed: bool = False
    lone: bool = False
    at: str = "found"
    label: str = ""


@dataclass
class Slip:
    """Where the parser stopped in a statement; `text` is the parsed text, `kinds` maps declared names to keywords."""

    chunk: Chunk
    text: str
    state: int
    token: Token
    expected: frozenset[str]
    kinds: Mapping[str, str]
    lone: bool = False
    groups: dict[str, str] = field(default_factory=dict)
    group_spans: dict[str, tuple[int, int]] = field(default_factory=dict)

    @cached_property
    def start(self) -> int:
        """Where the offending token begins in the text; its end if the statement ends too early."""
        at = self.token.start_pos
        return len(self.text.rstrip()) if self.at_end or at is None else at

    @cached_property
    def end(self) -> int:
        """Where the offending token ends."""
        return self.start + (0 if self.at_end else len(self.token))

    @property
    def at_end(self) -> bool:
        """Whether the statement ends too early."""
        return bool(self.token.type == "$END")

    @cached_property
    def before(self) -> str:
        """The text before the offending token, trailing spaces included."""
        return self.text[: self.start]

    @cached_property
    def last(self) -> tuple[int, int]:
        """The start and end of the token before the offending one."""
        found = _LAST.search(self.text, max(0, self.start - _WINDOW), self.start)
        return (found.start(1), found.end(1)) if found else (0, 0)

    @cached_property
    def word(self) -> str:
        """The statement's first word."""
        found = _WORD.match(self.text)
        return normalise(found[0]) if found else ""

    @cached_property
    def meant(self) -> str:
        """The expected keyword that the offending word resembles; a unit (`rad`, `min`) is none that was misspelt."""
        if not _WORD.fullmatch(self.token) or self.unit:
            return ""
        keywords = [name.lower() for name in self.expected if len(name) > 1 and name.lower() in _KEYWORDS]
        return next(iter(get_close_matches(self.token.lower(), keywords, n=1, cutoff=0.65)), "")

    @property
    def unit(self) -> bool:
        """Whether the offending word is the name of a usual unit."""
        return _pattern(_data()["units"]["names"]).fullmatch(self.token) is not None

    @cached_property
    def opener(self) -> int | None:
        """The offset of the innermost bracket that is open before the offending token."""
        opened, _ = brackets(self.before)
        return opened[-1] if opened else None

    def span(self, start: int, end: int) -> Span:
        """A span in the source."""
        return Span(self.chunk.source, self.chunk.start + start, self.chunk.start + end)


def brackets(text: str) -> tuple[list[int], int | None]:
    """The unclosed brackets, and the first one that closes none or the wrong one; quoted texts are ignored."""
    opened: list[int] = []
    for found in re.finditer(r'"[^"\n]*"|[()\[\]{}]', text):
        sign = found[0]
        if sign in _BRACKETS:
            opened.append(found.start())
        elif sign in ")]}":
            if not opened or _BRACKETS[text[opened[-1]]] != sign:
                return opened, found.start()
            opened.pop()
    return opened, None


def explain_slip(lark: Lark, slip: Slip) -> Diagnostic:
    """The diagnostic for a statement that could not be parsed."""
    wrong_bracket = _wrong_bracket(slip)
    if wrong_bracket is not None:
        return wrong_bracket
    for mistake in table(lark).candidates(slip.state, slip.token.type):
        if _fits(mistake, slip):
            return _say(mistake, slip)
    return _expected(slip)


# ------------------------------------------------------------------------------------------------------------ the table


@dataclass(frozen=True)
class Table:
    """The entries in their order, with the places (state, terminal) at which each is found."""

    entries: tuple[Mistake, ...]
    keys: tuple[frozenset[tuple[int, str]], ...]
    words: Mapping[str, tuple[str, ...]]
    clauses: Mapping[str, str]
    terminals: Mapping[str, str]

    def candidates(self, state: int, terminal: str) -> Iterator[Mistake]:
        """The entries that may fit, in the order of the file."""
        for mistake, keys in zip(self.entries, self.keys, strict=True):
            anywhere = not mistake.snippets and not mistake.terminals
            if anywhere or terminal in mistake.terminals or (state, terminal) in keys:
                yield mistake


_tables: WeakKeyDictionary[Lark, Table] = WeakKeyDictionary()


def table(lark: Lark) -> Table:
    """The table for a parser, built at the first error."""
    if lark not in _tables:
        data = _data()
        entries = tuple(Mistake(**_tuples(entry)) for entry in data["mistake"])
        keys = tuple(frozenset(_key(lark, snippet) for snippet in entry.snippets) for entry in entries)
        words = {word: tuple(meant.split()) for word, meant in data["words"].items()}
        _tables[lark] = Table(entries, keys, words, data["clauses"], data["terminals"])
    return _tables[lark]


@cache
def _data() -> JsonObject:
    return tomllib.loads(grammar_file("mistakes.toml").read_text(encoding="utf-8"))


def _tuples(entry: JsonObject) -> JsonObject:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}


def _key(lark: Lark, snippet: str) -> tuple[int, str]:
    """Where the parser stops in a snippet; raises `ValueError` if it parses."""
    try:
        lark.parse(snippet, start="statement")
    except UnexpectedInput as error:
        return where(error)
    raise ValueError(f"the snippet `{snippet}` of mistakes.toml parses")


def where(error: UnexpectedInput) -> tuple[int, str]:
    """The top parser state and the offending terminal of an error."""
    state = error.state if isinstance(error.state, int) else error.state.position
    return state, error.token.type if isinstance(error, UnexpectedToken) else "?"


# ------------------------------------------------------------------------------------------------ conditions of entries


def _fits(mistake: Mistake, slip: Slip) -> bool:
    """Whether an entry's conditions hold; stores the groups of its patterns in `slip`."""
    slip.groups, slip.group_spans = {}, {}
    if mistake.lone != slip.lone and (mistake.lone or mistake.statement or mistake.word):
        return False
    if (mistake.open and slip.opener is None) or (mistake.closed and slip.opener is not None):
        return False
    if (mistake.meant and not slip.meant) or (mistake.unit and not slip.unit):
        return False
    if mistake.word and not _word_is(mistake.word, slip):
        return False
    text, start = slip.text, slip.start
    if mistake.statement and not _keep(_pattern(mistake.statement).match(text, 0, start + _WINDOW), slip):
        return False
    if mistake.found and not _keep(_pattern(mistake.found).match(text, start, start + _WINDOW), slip):
        return False
    if mistake.before:
        before = _pattern(f"(?:{mistake.before})\\s*\\Z")
        if not _keep(before.search(text, max(0, start - _WINDOW), start), slip):
            return False
    return not mistake.state or slip.kinds.get(slip.groups[mistake.state]) == "state"


@cache
def _pattern(text: str) -> re.Pattern[str]:
    """A pattern of the table, with those of units in it (`%names%`, `%power%`, `%bracketed%`)."""
    for name, part in _data()["units"].items():
        text = text.replace(f"%{name}%", part)
    return re.compile(text)


def _keep(found: re.Match[str] | None, slip: Slip) -> bool:
    if found is None:
        return False
    for name, value in found.groupdict().items():
        if value is not None:
            slip.groups[name] = value
            slip.group_spans[name] = found.span(name)
    return True


def _word_is(kind: str, slip: Slip) -> bool:
    if kind == "state":
        return slip.kinds.get(slip.word) == "state"
    if kind == "slip":
        return slip.word not in slip.kinds and bool(_meant_statements(slip.word))
    return slip.word in kind.split()


def _meant_statements(word: str) -> tuple[str, ...]:
    """The statements that a misspelt first word may stand for."""
    words = _data()["words"]
    lower = word.lower()
    if lower in words:
        return tuple(words[lower].split())
    return tuple(get_close_matches(lower, WORDS, n=1, cutoff=0.7))


# ------------------------------------------------------------------------------------------------------------- messages


def _say(mistake: Mistake, slip: Slip) -> Diagnostic:
    fields = _fields(slip)
    labels: tuple[Label, ...] = ()
    if slip.opener is not None and (mistake.code == "GB105" or slip.at_end):
        labels = (Label(slip.span(slip.opener, slip.opener + 1), "opened here"),)
    return Diagnostic(
        mistake.code,
        mistake.message.format_map(fields),
        _place(mistake.at, slip),
        mistake.label.format_map(fields),
        labels,
        help=mistake.help.format_map(fields),
    )


def _fields(slip: Slip) -> dict[str, str]:
    """The values that may be substituted in the messages of the table."""
    choices = [f"`{name}`" for name in _meant_statements(slip.word)]
    opener = slip.text[slip.opener] if slip.opener is not None else "("
    return {
        "found": str(slip.token),
        "last": slip.text[slip.last[0] : slip.last[1]],
        "word": slip.word,
        "meant": slip.meant,
        "statement": listed(choices, "or"),
        "clauses": _data()["clauses"].get(slip.word, ""),
        "open": opener,
        "close": _BRACKETS[opener],
        **slip.groups,
        "product": _product(slip.groups.get("unit", "")),
    }


def _product(unit: str) -> str:
    """A unit as it is written here: `kg m^-3` as `kg*m^-3`, `mol L-1` as `mol*L^-1`."""
    powers = re.sub(r"(?<=[^\W\d_])(-?\d+)\b", r"^\1", unit)
    return re.sub(r"(?<=[\w)])\s+(?=[\w(])", "*", powers)


def _place(at: str, slip: Slip) -> Span:
    match at:
        case "found":
            return slip.span(slip.start, max(slip.end, slip.start))
        case "before":
            return slip.span(*slip.last)
        case "after":
            return slip.span(slip.last[1], slip.last[1])
        case "both":
            return slip.span(slip.last[0], slip.end)
        case "word":
            return slip.span(0, len(slip.word))
        case "statement":
            return slip.span(0, len(slip.text))
        case _:
            return slip.span(*slip.group_spans[at])


def _wrong_bracket(slip: Slip) -> Diagnostic | None:
    """A closing bracket that closes nothing or the wrong one; a bracket open at the end of the statement."""
    opened, wrong = brackets(slip.text)
    if wrong is not None and wrong <= slip.start:
        sign = slip.text[wrong]
        if re.search(r"\bin\s*\Z", slip.text[:wrong]):
            return None  # `in ]0, 1[`: the table says how a range is written
        if not opened:
            message = f"this `{sign}` closes nothing"
            return Diagnostic(
                "GB106", message, slip.span(wrong, wrong + 1), help="remove it, or open the bracket before"
            )
        opener = slip.text[opened[-1]]
        message = f"`{opener}` is closed by `{sign}`"
        label = Label(slip.span(opened[-1], opened[-1] + 1), "opened here")
        help = f"write `{_BRACKETS[opener]}`"
        return Diagnostic("GB107", message, slip.span(wrong, wrong + 1), labels=(label,), help=help)
    if slip.at_end and opened and not _wants_operand(slip):
        opener = slip.text[opened[-1]]
        message = f"this `{opener}` is never closed"
        return Diagnostic(
            "GB105",
            message,
            slip.span(opened[-1], opened[-1] + 1),
            "opened here",
            (Label(slip.span(slip.start, slip.start), f"the statement ends without `{_BRACKETS[opener]}`"),),
            help=f"write the `{_BRACKETS[opener]}`; indent a line that continues the statement",
        )
    return None


def _wants_operand(slip: Slip) -> bool:
    return bool(re.search(r"[-+*/^]\s*\Z", slip.before))


def _expected(slip: Slip) -> Diagnostic:
    """The diagnostic if no entry of the table fits."""
    words = _data()["terminals"]
    wanted = listed(_wanted(slip.expected - ({"$END"} if slip.lone else set()), words), "or")
    if slip.at_end:
        message = f"this {'expression' if slip.lone else 'statement'} ends too early"
        return Diagnostic("GB101", message, slip.span(slip.start, slip.start), label=f"expected {wanted}")
    message = f"`{slip.token}` is not allowed here"
    labels: tuple[Label, ...] = ()
    if slip.opener is not None:
        labels = (Label(slip.span(slip.opener, slip.opener + 1), "inside this bracket"),)
    return Diagnostic("GB100", message, slip.span(slip.start, slip.end), f"expected {wanted}", labels)


def _wanted(terminals: Iterable[str], words: Mapping[str, str]) -> list[str]:
    """The expected terminals in the user's words; operators and comparisons are listed as one each."""
    kinds = set(terminals)
    if kinds >= _OPERAND:
        kinds = kinds - _OPERAND - {"IF", "NOT"} | {"expression"}
    found = {words.get(name, f"`{name.lower()}`") for name in kinds}
    return sorted(found, key=lambda text: (text.startswith("`"), text))


def listed(items: list[str], last: str) -> str:
    """`a, b or c`."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} {last} {items[-1]}"
