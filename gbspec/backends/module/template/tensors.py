"""Weights files. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np

# <body>
# ---------------------------------------------------------------------- weights files
# The safetensors format: 8 bytes with the length of a JSON header (little-endian), the header (name -> dtype, shape,
# offsets into the rest; `__metadata__` holds strings), and the numbers as in memory.

_DTYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "|i1", "U8": "|u1"}


def _read_tensors(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Arrays (float64 where they are floating) and metadata of a file. Raises ValueError if it is malformed."""
    data = Path(path).read_bytes()

    def wrong(what: str) -> ValueError:
        return ValueError(f"{path} is not a usable safetensors file: {what}")

    if len(data) < 8:
        raise wrong("it is shorter than its own header")
    (length,) = struct.unpack("<Q", data[:8])
    if length > len(data) - 8:
        raise wrong(f"its header claims {length} bytes, the file has {len(data)}")
    try:
        header = json.loads(data[8 : 8 + length].decode("utf-8"), object_pairs_hook=_without_repeats)
    except ValueError as error:
        raise wrong(f"its header cannot be read ({error})") from None
    if not isinstance(header, dict):
        raise wrong("its header is not a table of tensors")
    body = memoryview(data)[8 + length :]
    metadata = header.pop("__metadata__", {})
    if not isinstance(metadata, dict) or not all(isinstance(value, str) for value in metadata.values()):
        raise wrong("its metadata are not strings")
    arrays, spans = {}, []
    for name, entry in header.items():
        try:
            dtype, shape = np.dtype(_DTYPES[entry["dtype"]]), tuple(entry["shape"])
            begin, end = entry["data_offsets"]
        except (KeyError, TypeError, ValueError):
            raise wrong(f"the entry of {name!r} is incomplete or of an unknown type") from None
        if not all(type(n) is int and n >= 0 for n in (*shape, begin, end)):
            raise wrong(f"the entry of {name!r} has sizes that are not whole numbers")
        size = dtype.itemsize
        for n in shape:
            size *= n
        if end - begin != size or end > len(body):
            raise wrong(f"{name!r} should have {size} bytes, at {begin} to {end} of {len(body)}")
        array = np.frombuffer(body[begin:end], dtype).reshape(shape)
        arrays[name] = array.astype(np.float64) if dtype.kind == "f" else array.copy()
        spans.append((begin, end))
    spans.sort()
    ends = [0, *(end for _, end in spans)]
    if [begin for begin, _ in spans] != ends[:-1] or ends[-1] != len(body):
        raise wrong("its tensors overlap or leave gaps")
    return arrays, metadata


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a name occurs twice")
    return table


def _write_tensors(path: str | os.PathLike[str], arrays: dict[str, Any], metadata: dict[str, str]) -> None:
    """Writes float64 arrays, atomically through a temporary file."""
    header: dict[str, Any] = {"__metadata__": metadata} if metadata else {}
    blocks, offset = [], 0
    for name in sorted(arrays):
        block = np.ascontiguousarray(arrays[name], dtype="<f8")
        header[name] = {"dtype": "F64", "shape": list(block.shape), "data_offsets": [offset, offset + block.nbytes]}
        blocks.append(block.tobytes())
        offset += block.nbytes
    text = json.dumps(header, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 8)
    temporary = Path(f"{os.fspath(path)}.part")
    temporary.write_bytes(b"".join((struct.pack("<Q", len(text)), text, *blocks)))
    os.replace(temporary, path)
