"""Checks of paths, writing of files, and numbers for JSON; user errors become diagnostics."""

from __future__ import annotations

import errno
import math
import os
import stat
import tempfile
from pathlib import Path

from gbspec.diagnostics import Diagnostic, UserError


def existing(path: str | Path, *, kind: str = "file") -> Path:
    """The path of an existing file; else raises `UserError` (GB801, GB802). `kind` is used in the message."""
    found = Path(path)
    if not found.exists():
        raise UserError([Diagnostic("GB801", f"the {kind} `{path}` does not exist", None, help=_nearby(found))])
    if found.is_dir():
        message = f"`{path}` is a directory, not a {kind}"
        raise UserError([Diagnostic("GB802", message, None, help=f"give the path of the {kind}")])
    return found


def read_bytes(path: str | Path) -> bytes:
    """The bytes of a regular file. Raises OSError, for a pipe or a device too, which might never end or begin."""
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(handle, "rb") as file:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, not a file; save its content first", str(path))
        return file.read()


def writable(path: str | Path) -> Path:
    """The path, if a file can be written there; raises `UserError` (GB802, GB805) otherwise. Writes nothing."""
    target = Path(path)
    if target.is_dir():
        message = f"`{path}` is a directory; a file name is needed"
        raise UserError([Diagnostic("GB802", message, None, help="give the path of a file in it")])
    folder = target.parent
    if not folder.is_dir():
        message = f"`{path}` cannot be written: there is no folder `{folder}`"
        raise UserError([Diagnostic("GB805", message, None, help=f"create it first: mkdir -p {folder}")])
    if not os.access(target if target.exists() else folder, os.W_OK):
        message = f"`{path}` cannot be written: permission denied"
        raise UserError([Diagnostic("GB805", message, None, help="choose another path")])
    return target


def write_text(path: str | Path, text: str) -> None:
    """Writes a text (UTF-8, LF) as `write_bytes` does."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, data: bytes) -> None:
    """Writes a file atomically: a reader sees either the old or the new content."""
    target = writable(path)
    if target.exists() and not target.is_file():  # /dev/stdout and the like are written to, not replaced
        target.write_bytes(data)
        return
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        mode = target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~_umask()
        os.chmod(name, mode)
        os.replace(name, target)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _umask() -> int:
    """The file mode mask of the process, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _nearby(path: Path) -> str:
    """A help line: the most similar name in the same folder, if there is one."""
    import difflib

    try:
        names = [entry.name for entry in path.parent.iterdir()]
    except OSError:
        return f"there is no folder `{path.parent}` either; paths are relative to {Path.cwd()}"
    close = difflib.get_close_matches(path.name, names, n=1)
    if close:
        return f"did you mean `{path.parent / close[0]}`?"
    return f"paths are relative to {Path.cwd()}"


def finite(value: float | None) -> float | None:
    """A number for JSON: None (`null`) if it is unknown or not finite, since JSON has no NaN."""
    return float(value) if value is not None and math.isfinite(value) else None
