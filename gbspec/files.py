"""Checks of paths, writing of files, and numbers for JSON; user errors become diagnostics."""

from __future__ import annotations

import errno
import glob
import math
import os
import shlex
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.given import WRITTEN, require_path

ASIDE = ".gbspec-part"
"""Part of the names of files that are being written."""
ABANDONED = 3600.0
"""Seconds after which a file that is being written is taken for one that was left behind."""


def existing(path: str | Path, *, kind: str = "file") -> Path:
    """The path of an existing file; else raises `UserError` (GB801, GB802). `kind` is used in the message."""
    found = Path(path)
    if not found.exists():
        raise UserError([Diagnostic("GB801", f"the {kind} `{path}` does not exist", None, help=_nearby(found))])
    if found.is_dir():
        message = f"`{path}` is a directory, not a {kind}"
        raise UserError([Diagnostic("GB802", message, None, help=f"give the path of the {kind}")])
    return found


class TooLargeError(OSError):
    """A file that is larger than its reader allows."""


def read_bytes(path: str | Path, most: int | None = None) -> bytes:
    """The bytes of a regular file. Raises OSError, for a pipe or a device too, which might never end or begin.

    A file of more than `most` bytes is not read; raises `TooLargeError`.
    """
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except PermissionError:
        if Path(path).is_dir():  # which Windows does not open
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path)) from None
        raise
    with os.fdopen(handle, "rb") as file:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, not a file; save its content first", str(path))
        if most is not None and os.fstat(handle).st_size > most:
            raise TooLargeError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
        return file.read()


def writable(path: str | Path) -> Path:
    """The path, if a file can be written there; raises `UserError` (GB802, GB805) otherwise. Writes nothing.

    Raises TypeError for what is no path.
    """
    require_path(path, WRITTEN)
    target = Path(path)
    if target.is_dir():
        message = f"`{path}` is a directory; a file name is needed"
        raise UserError([Diagnostic("GB802", message, None, help="give the path of a file in it")])
    folder = target.parent
    if not folder.is_dir():
        message = f"`{path}` cannot be written: there is no folder `{folder}`"
        raise UserError(
            [Diagnostic("GB805", message, None, help=f"create it first: mkdir -p {shlex.quote(str(folder))}")]
        )
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
    with aside(target) as temporary:
        temporary.write_bytes(data)


@contextmanager
def aside(target: Path) -> Iterator[Path]:
    """A path beside the target to write to, which then becomes the target: complete, or as it was before.

    A process that is killed leaves the path beside behind; `clear` and a later write to the same target remove it.
    """
    if target.exists() and not target.is_file():
        yield target
        return
    _clear_older(target)
    resolved = target.resolve() if target.is_symlink() else target  # the link stays, what it points to is replaced
    handle, name = tempfile.mkstemp(dir=resolved.parent, prefix=f".{target.name[:100]}.", suffix=ASIDE + target.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        mode = resolved.stat().st_mode & 0o777 if resolved.exists() else 0o666 & ~_umask()
        os.chmod(temporary, mode)
        _publish(temporary, resolved)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename in (None, name):
            error.filename = str(target)  # the user knows this name
        raise


def _publish(temporary: Path, target: Path) -> None:
    """Renames after the content has reached the disk, so that a power failure cannot leave an empty file."""
    with temporary.open("r+b") as file:
        os.fsync(file.fileno())
    os.replace(temporary, target)
    if hasattr(os, "O_DIRECTORY"):  # where a folder can be opened, its new entry is written to the disk as well
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            with suppress(OSError):  # some file systems cannot do this
                os.fsync(folder)
        finally:
            os.close(folder)


def is_aside(name: str) -> bool:
    """Whether a file is named like one that was left behind by a process that was killed while it wrote."""
    return name.startswith(".") and ASIDE in name


def clear(folder: Path) -> None:
    """Removes what killed processes left behind in a folder and its subfolders; nobody else may be writing there."""
    for path in sorted(folder.rglob(f".*{ASIDE}*")):
        if path.is_file() and is_aside(path.name):
            path.unlink(missing_ok=True)


def _clear_older(target: Path) -> None:
    """Removes files beside the target that are too old to belong to a process that is still writing it."""
    now = time.time()
    for path in target.parent.glob(f".{glob.escape(target.name[:100])}.*{ASIDE}*"):
        with suppress(OSError):
            if now - path.stat().st_mtime > ABANDONED:
                path.unlink()


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
