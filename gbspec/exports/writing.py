"""Writes the files of an export, as a folder or an archive: complete, or not at all."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

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


def check(path: str | Path, packed: bool) -> None:
    """Raises `UserError` if nothing can be written there (GB802, GB805), or a folder there is no export (GB880)."""
    target = Path(path)
    if packed or target.suffix == ".zip" or not target.is_dir():
        writable(path)
        return
    if not (target / RECORD).is_file() and any(target.iterdir()):
        message = f"the folder `{path}` has files that are not those of an export"
        raise UserError([Diagnostic("GB880", message, None, help="name a new folder, or an archive: `-o NAME.zip`")])


def write(path: str | Path, files: Mapping[str, bytes], packed: bool) -> int:
    """Writes the files to an archive, or to a folder unless the path ends in `.zip`; returns the number of bytes."""
    check(path, packed)
    target = Path(path)
    if packed or target.suffix == ".zip":
        data = archived(files)
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
