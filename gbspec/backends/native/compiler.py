"""Compiles C source with the system's compiler and loads it; a cache keyed by content, which workers may share."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

COMPILERS = ("cc", "gcc", "clang")

TIME_LIMIT = 120.0
"""Seconds after which a compilation is aborted."""


class CompilerError(Exception):
    """There is no compiler, or it failed; the message is one line."""


def compiled(source: str) -> ctypes.CDLL:
    """The library compiled from a source, from the cache if possible. Raises CompilerError."""
    compiler = find_compiler()
    key = hashlib.sha256("\0".join([source, *_identity(compiler), repr(_flag_sets())]).encode()).hexdigest()
    return _load(source, compiler, key)


_loaded: dict[str, ctypes.CDLL] = {}


def _load(source: str, compiler: str, key: str) -> ctypes.CDLL:
    if key not in _loaded:
        folder = _trusted_directory()
        path = folder / f"{key}.so"
        if not trusted(path):
            _compile(source, compiler, path)
        try:
            _loaded[key] = ctypes.CDLL(str(path))
        except OSError as error:
            raise CompilerError(f"the compiled kernel cannot be loaded ({error})") from None
    return _loaded[key]


@cache
def find_compiler() -> str:
    """The C compiler: `$CC`, else the first found of cc, gcc and clang. Raises CompilerError."""
    for name in (os.environ.get("CC", ""), *COMPILERS):
        path = shutil.which(name) if name else None
        if path is not None:
            return path
    raise CompilerError("there is no C compiler (cc, gcc, clang)")


def cache_directory() -> Path:
    """The directory of compiled kernels: `$GBSPEC_CACHE`, else `gbspec` in the user's cache directory."""
    named = os.environ.get("GBSPEC_CACHE")
    if named:
        return Path(named)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "gbspec"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "gbspec" / "Cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gbspec"


_own: list[tempfile.TemporaryDirectory[str]] = []
"""The folder of this process, where the one of the user cannot be trusted."""


def _trusted_directory() -> Path:
    """The cache directory, if nobody else can write there; otherwise a folder of this process alone.

    A library from a folder that others can write to would run their code.
    """
    folder = cache_directory()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if trusted(folder) and os.access(folder, os.W_OK):
            return folder.resolve()
    except OSError:
        pass
    if not _own:
        _own.append(tempfile.TemporaryDirectory(prefix="gbspec-kernels-"))
    return Path(_own[0].name)


def trusted(path: Path) -> bool:
    """Whether a file or folder exists and only this user, or the administrator, can have written it.

    Nobody else can rename anything in the folders above it either; a library is no link.
    """
    if not hasattr(os, "geteuid"):  # Windows: the user's own cache directory is protected by its access list
        return path.exists()
    allowed = (os.geteuid(), 0)
    try:
        status = path.lstat()
        if stat.S_ISLNK(status.st_mode) and path.suffix == ".so":
            return False
        status = path.stat()
        if status.st_uid not in allowed or _open_to_others(status):
            return False
        return all(_passable(above.stat(), allowed) for above in path.resolve().parents)
    except OSError:
        return False


def _passable(status: os.stat_result, allowed: tuple[int, ...]) -> bool:
    """Whether others cannot replace what lies in a folder: they cannot write, or it is sticky like `/tmp`."""
    return status.st_uid in allowed and (not _open_to_others(status) or bool(status.st_mode & stat.S_ISVTX))


def _open_to_others(status: os.stat_result) -> bool:
    """Whether others can write; the group that only this user is in, which many systems make, is no other."""
    if status.st_mode & stat.S_IWOTH:
        return True
    return bool(status.st_mode & stat.S_IWGRP) and status.st_gid != _own_group()


@cache
def _own_group() -> int | None:
    """The group with the name of the user and no other member; None if there is none."""
    import grp
    import pwd

    try:
        name = pwd.getpwuid(os.geteuid()).pw_name
        group = grp.getgrnam(name)
    except KeyError:
        return None
    return group.gr_gid if set(group.gr_mem) <= {name} else None


@cache
def _identity(compiler: str) -> tuple[str, ...]:
    """What determines the code besides the source: the compiler's file and the processor's instruction set."""
    resolved = Path(compiler).resolve()
    status = resolved.stat()
    return str(resolved), str(status.st_mtime_ns), str(status.st_size), platform.machine(), _processor()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return f"{platform.processor()} {platform.node()}"
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.node())


def _flag_sets() -> list[list[str]]:
    """Flags to try, the best first: not every compiler knows those for the local processor."""
    common = ["-std=gnu11", "-O3", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC"]
    wide = [["-march=native", "-mprefer-vector-width=512"]] if platform.machine() in ("x86_64", "AMD64") else []
    return [[*common, *native] for native in [*wide, ["-march=native"], ["-mcpu=native"], []]]


def _compile(source: str, compiler: str, path: Path) -> None:
    """Compiles to `path`, atomically: the file is complete or does not exist."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as directory:
            text, out = Path(directory) / "kernel.c", Path(directory) / "kernel.so"
            text.write_text(source, encoding="utf-8")
            message = ""
            for flags in _flag_sets():
                command = [compiler, *flags, str(text), "-o", str(out), "-lm"]
                done = subprocess.run(command, capture_output=True, text=True, timeout=TIME_LIMIT, check=False)
                if done.returncode == 0:
                    os.chmod(out, 0o700)
                    os.replace(out, path)
                    return
                message = done.stderr.strip().splitlines()[0] if done.stderr.strip() else f"status {done.returncode}"
    except subprocess.TimeoutExpired:
        raise CompilerError(f"{compiler} took longer than {TIME_LIMIT:.0f} s to compile the kernel") from None
    except OSError as error:
        raise CompilerError(f"the kernel cannot be compiled ({error})") from None
    raise CompilerError(f"{compiler} cannot compile the kernel ({message})")
