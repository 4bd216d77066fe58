"""Compiles C source with the system's compiler and loads it; a cache keyed by content, which workers may share."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
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
        path = cache_directory() / f"{key[:40]}.so"
        if not path.is_file():
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
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gbspec"


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
                    os.replace(out, path)
                    return
                message = done.stderr.strip().splitlines()[0] if done.stderr.strip() else f"status {done.returncode}"
    except subprocess.TimeoutExpired:
        raise CompilerError(f"{compiler} took longer than {TIME_LIMIT:.0f} s to compile the kernel") from None
    except OSError as error:
        raise CompilerError(f"the kernel cannot be compiled ({error})") from None
    raise CompilerError(f"{compiler} cannot compile the kernel ({message})")
