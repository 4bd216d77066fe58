"""Writes the files of an export, as a folder or an archive: complete, or not at all."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.files import ASIDE, writable, write_bytes

RECORD = "export.json"
"""The file by which a folder is known as an export, which a new one may replace."""
EPOCH = (1980, 1, 1, 0, 0, 0)
"""The time of all files of an archive: equal exports are equal files."""


def archived(files: Mapping[str, bytes]) -> bytes:
    """A zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, EPOCH)
            entry.external_attr = 0o644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    return buffer.getvalue()


Layout = Literal["archive", "file", "folder"]


def layout(path: str | Path, packed: bool, single: str = "") -> Layout:
    """How files are written to a path: always an archive if `packed`, one file for the suffix `single`."""
    suffix = Path(path).suffix
    if packed or suffix == ".zip":
        return "archive"
    return "file" if single and suffix == single else "folder"


def check(path: str | Path, layout: Layout) -> None:
    """Raises `UserError` if nothing can be written there (GB802, GB805), or a folder there is no export (GB880)."""
    target = Path(path)
    if layout != "folder" or not target.is_dir():
        writable(path)
        return
    if not (target / RECORD).is_file() and any(target.iterdir()):
        message = f"the folder `{path}` has files that are not those of an export"
        raise UserError([Diagnostic("GB880", message, None, help="name a new folder, or an archive: `-o NAME.zip`")])


def write(path: str | Path, files: Mapping[str, bytes], layout: Layout) -> int:
    """Writes the files; returns the number of bytes. As a file, the first of them."""
    check(path, layout)
    target = Path(path)
    if layout != "folder":
        data = archived(files) if layout == "archive" else next(iter(files.values()))
        write_bytes(target, data)
        return len(data)
    temporary = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name[:100]}.", suffix=ASIDE))
    try:
        for name, content in files.items():
            place = temporary / name
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)
        os.chmod(temporary, 0o755)
        _replace(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return sum(map(len, files.values()))


def _replace(new: Path, target: Path) -> None:
    """Renames a folder to one that may exist, which is an earlier export."""
    if not target.exists():
        os.rename(new, target)
        return
    old = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name[:100]}.", suffix=ASIDE))
    os.rename(target, old / target.name)
    try:
        os.rename(new, target)
    except OSError:
        os.rename(old / target.name, target)
        raise
    finally:
        shutil.rmtree(old, ignore_errors=True)
