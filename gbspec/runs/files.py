"""Files of a run directory, each written atomically."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as dump_tensors

from gbspec.arrays import Array
from gbspec.files import read_bytes
from gbspec.json_values import JsonObject

FIT, MODEL, MODULE, HISTORY, MEMBERS = "fit.json", "model.gb", "model.py", "history.csv", "members"
WEIGHTS, CHECKPOINT, CHECKPOINT_BEST = "weights.safetensors", "checkpoint.safetensors", "checkpoint.best.safetensors"


def member_directory(run: Path, member: int) -> Path:
    """The directory of a member's files."""
    return run / MEMBERS / str(member)


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file atomically: a reader, or a crash, sees the old content or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


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
    """Writes arrays as safetensors, with remarks (JSON values) in the header of the file."""
    whole = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    write_bytes(path, dump_tensors(whole, {"remarks": json.dumps(_finite(remarks))}))


def read_tensors(path: Path) -> tuple[dict[str, Array], JsonObject]:
    """Arrays and remarks of a file written by `write_tensors`. Raises ValueError if it is damaged."""
    content = read_bytes(path)
    try:
        arrays = load_tensors(content)
        length = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + length])
        remarks = json.loads(header.get("__metadata__", {}).get("remarks", "{}"))
    except (SafetensorError, UnicodeDecodeError, json.JSONDecodeError, KeyError) as error:
        raise ValueError(f"`{path}` is damaged: {error}") from None
    return dict(arrays), remarks


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
