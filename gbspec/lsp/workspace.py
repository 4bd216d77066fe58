"""The texts of files, those open in the editor before those on disk, their trees, and how they extend one another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from gbspec.diagnostics import Findings, Source, Span, UserError
from gbspec.lsp.index import Names, Occurrence, names_of, occurrences
from gbspec.syntax import ast, decode, parse, read_source

_MAX_FILES = 2000
_SKIPPED = frozenset({"node_modules", "__pycache__"})


@dataclass(frozen=True)
class Parsed:
    """A text and its tree; `broken` if a statement could not be parsed."""

    source: Source
    file: ast.File
    broken: bool


@dataclass
class Workspace:
    """The open texts, and a cache of the files read and parsed (valid while they do not change)."""

    roots: tuple[Path, ...] = ()
    _open: dict[Path, Source] = field(default_factory=dict)
    _disk: dict[Path, tuple[tuple[int, int], Source]] = field(default_factory=dict)
    _parsed: dict[Path, Parsed] = field(default_factory=dict)
    _indexed: dict[Path, tuple[tuple[Source, ...], Names, tuple[Occurrence, ...]]] = field(default_factory=dict)

    # ------------------------------------------------------------------------------------------------------- texts

    def put(self, path: str | Path, text: str) -> None:
        """Stores the full text of a file that was opened or changed in the editor."""
        self._open[key(path)] = decode(str(path), text.encode("utf-8", "replace"))

    def drop(self, path: str | Path) -> None:
        """Forgets the text of a closed file; the one on disk is used again."""
        self._open.pop(key(path), None)

    def opened(self) -> tuple[Path, ...]:
        """The files that are open in the editor."""
        return tuple(self._open)

    def source(self, path: str | Path) -> Source:
        """The text of a file, from the editor or from disk; raises `UserError` if there is none."""
        path = Path(path)
        own = self._open.get(key(path))
        if own is not None:
            return own
        try:
            status = path.stat()
        except (OSError, ValueError):
            return read_source(path)
        stamp = (status.st_mtime_ns, status.st_size)
        known = self._disk.get(key(path))
        if known is None or known[0] != stamp:
            known = self._disk[key(path)] = (stamp, read_source(path))
        return known[1]

    def parsed(self, path: str | Path) -> Parsed | None:
        """The text of a file and the tree of its readable statements; None if it does not exist or is not text."""
        try:
            source = self.source(path)
        except UserError:
            return None
        known = self._parsed.get(key(path))
        if known is None or known.source is not source:
            findings = Findings()
            file = parse(source, findings) or ast.File(Span(source, 0, len(source.text)), ())
            known = self._parsed[key(path)] = Parsed(source, file, findings.failed)
        return known

    # ----------------------------------------------------------------------------------------------------- families

    def chain(self, path: str | Path) -> tuple[Parsed, ...]:
        """The file, the one that it extends, and so on, as far as they can be read."""
        found: list[Parsed] = []
        for step in self._steps(path):
            parsed = self.parsed(step)
            if parsed is not None:
                found.append(parsed)
        return tuple(found)

    def extends(self, path: str | Path, other: str | Path) -> bool:
        """Whether a file is the other or extends it, directly or through others; the other itself is not read."""
        wanted = key(other)
        return any(key(step) == wanted for step in self._steps(path))

    def _steps(self, path: str | Path) -> Iterator[Path]:
        """The paths along a chain, each yielded before its file is read."""
        seen: set[Path] = set()
        current: Path | None = Path(path)
        while current is not None and key(current) not in seen:
            seen.add(key(current))
            yield current
            parsed = self.parsed(current)
            current = extended(parsed.file) if parsed is not None else None

    def descendants(self, path: str | Path) -> tuple[Parsed, ...]:
        """The file and all known files that extend it, directly or through others."""
        wanted = key(path)
        found = {wanted: self.parsed(path)}
        for other in self._known(Path(path)):
            if key(other) not in found and self.extends(other, path):
                found[key(other)] = self.parsed(other)
        return tuple(p for p in found.values() if p is not None)

    def _known(self, path: Path) -> Iterator[Path]:
        """The open files and those in the project's folders (if there are none: in the file's folder)."""
        yield from self._open
        count = 0
        folders = self.roots or (path.parent,)
        for folder in folders:
            pattern = "**/*.gb" if self.roots else "*.gb"
            for other in folder.glob(pattern):
                hidden = any(p.startswith(".") or p in _SKIPPED for p in other.relative_to(folder).parts)
                if not hidden and key(other) not in self._open:
                    yield other
                    count += 1
                if count >= _MAX_FILES:
                    return

    # --------------------------------------------------------------------------------------------------------- names

    def names(self, path: str | Path) -> Names:
        """The declarations of the file and of those it extends."""
        return self._index(path)[1]

    def occurrences(self, path: str | Path) -> tuple[Occurrence, ...]:
        """Every name in the file with its symbol; empty if the file cannot be read."""
        return self._index(path)[2]

    def _index(self, path: str | Path) -> tuple[tuple[Source, ...], Names, tuple[Occurrence, ...]]:
        chain = self.chain(path)
        sources = tuple(p.source for p in chain)
        known = self._indexed.get(key(path))
        if known is None or known[0] != sources:
            names = names_of([p.file for p in chain])
            found = occurrences(chain[0].file, names) if chain else ()
            known = self._indexed[key(path)] = (sources, names, found)
        return known

    def with_texts(self, texts: dict[Path, str]) -> Workspace:
        """The same files with other texts, to inspect the result of an edit."""
        other = Workspace(self.roots, dict(self._open), dict(self._disk), dict(self._parsed), dict(self._indexed))
        for path, text in texts.items():
            other.put(path, text)
        return other


def key(path: str | Path) -> Path:
    """The resolved path of a file, which identifies it."""
    return Path(path).resolve()


def extended(file: ast.File) -> Path | None:
    """The path of the file that this one extends, without checking whether that is allowed; None if it extends none."""
    for statement in file.statements:
        if isinstance(statement, ast.ModelStatement) and statement.extends is not None:
            named = statement.extends.value
            if named and "\0" not in named:
                return Path(file.span.source.path).parent / named
    return None
