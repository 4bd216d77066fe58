"""Files of a run directory, each written atomically."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as dump_tensors

from gbspec.arrays import Array
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.files import aside, is_aside, read_bytes
from gbspec.json_values import JsonObject

FIT, MODEL, MODULE, HISTORY, MEMBERS = "fit.json", "model.gb", "model.py", "history.csv", "members"
LOCK, DATA = ".lock", "data.safetensors"
WEIGHTS, CHECKPOINT, CHECKPOINT_BEST = "weights.safetensors", "checkpoint.safetensors", "checkpoint.best.safetensors"


def member_directory(run: Path, member: int) -> Path:
    """The directory of a member's files."""
    return run / MEMBERS / str(member)


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file atomically: a reader, or a crash, sees the old content or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with aside(path) as temporary:
        temporary.write_bytes(content)


def digest(path: Path) -> str:
    """The SHA-256 (hexadecimal) of a file's content. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_blank(directory: Path) -> bool:
    """Whether a directory holds only what a killed process may leave: empty folders, incomplete files, a lock."""
    return all(path.is_dir() or is_aside(path.name) or path.name == LOCK for path in directory.rglob("*"))


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Writes JSON with keys in the order given; numbers in full precision, NaN and infinities as null."""
    write_bytes(path, (json.dumps(_finite(content), indent=2, ensure_ascii=False) + "\n").encode("utf-8"))


def _finite(value: object) -> object:
    """The value with numbers of numpy as Python's, and NaN and infinities as None (JSON has neither)."""
    match value:
        case Mapping():
            return {key: _finite(item) for key, item in value.items()}
        case np.ndarray():
            return _finite(value.tolist())
        case list() | tuple():
            return [_finite(item) for item in value]
        case np.generic():
            return _finite(value.item())
        case float():
            return value if np.isfinite(value) else None
        case _:
            return value


def write_tensors(path: Path, arrays: Mapping[str, Array], remarks: Mapping[str, object]) -> None:
    """Writes arrays as safetensors, with remarks (JSON values) and a digest of both in the header of the file."""
    whole = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    text = json.dumps(_finite(remarks))
    write_bytes(path, dump_tensors(whole, {"remarks": text, "sha256": digest_of(whole, text)}))


def read_tensors(path: Path) -> tuple[dict[str, Array], JsonObject]:
    """Arrays and remarks of a file written by `write_tensors`. Raises ValueError if it is damaged.

    Files of version 0.1.0 have no digest.
    """
    content = read_bytes(path)
    try:
        arrays = dict(load_tensors(content))
        length = int.from_bytes(content[:8], "little")
        metadata = json.loads(content[8 : 8 + length]).get("__metadata__", {})
        text = metadata.get("remarks", "{}")
        remarks = json.loads(text)
    except (SafetensorError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise ValueError(f"`{path}` is damaged: {error}") from None
    if not isinstance(remarks, dict) or metadata.get("sha256") not in (None, digest_of(arrays, text)):
        raise ValueError(f"`{path}` is damaged: its content is not what was written")
    return arrays, remarks


def digest_of(arrays: Mapping[str, Array], text: str) -> str:
    """The SHA-256 (hexadecimal) of arrays, with their names, types and shapes, and of a text."""
    found = hashlib.sha256(text.encode("utf-8"))
    for name, value in sorted(arrays.items()):
        found.update(f"\0{name}\0{value.dtype.str}{value.shape}\0".encode())
        found.update(np.ascontiguousarray(value).tobytes())
    return found.hexdigest()


def history_header(constants: Sequence[str]) -> list[str]:
    """Columns of `history.csv`."""
    return ["member", "stage", "iteration", "seconds", "loss", *constants]


def write_history(path: Path, constants: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Writes the history of all members: one row per iteration."""
    import io

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(history_header(constants))
    writer.writerows([[_cell(value) for value in row] for row in rows])
    write_bytes(path, text.getvalue().encode("utf-8"))


def _cell(value: object) -> str:
    return repr(float(value)) if isinstance(value, float | np.floating) else str(value)


def read_history(path: Path) -> list[dict[str, str]]:
    """The rows of a history; empty if there is no such file. Raises UserError (GB852) if it is damaged."""
    if not path.is_file():
        return []
    try:
        with path.open(encoding="utf-8", newline="") as file:
            table = csv.DictReader(file, restkey="")
            rows, header = list(table), list(table.fieldnames or ())
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError([Diagnostic("GB852", f"`{path}` is damaged: {error}", None)]) from None
    wrong = next((row for row in rows if not _complete(row)), None)
    if wrong is not None or header[:5] != history_header(()):
        at = f"row {rows.index(wrong) + 2}" if wrong is not None else "its header"
        message = f"`{path}` is damaged: {at} is incomplete"
        raise UserError([Diagnostic("GB852", message, None, help="`train --resume` writes it again")])
    return rows


def _complete(row: Mapping[str, object]) -> bool:
    """Whether a row has all its cells, with numbers where they are expected."""
    if None in row.values() or "" in row:
        return False
    try:
        for name, cell in row.items():
            if name != "stage":
                float(str(cell))
    except ValueError:
        return False
    return True
