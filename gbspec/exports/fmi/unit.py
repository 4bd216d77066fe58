"""The files of a functional mock-up unit: description, sources, binary of this platform, and the model."""

from __future__ import annotations

import platform
import shutil
import sys
import tempfile
import uuid
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib import resources
from pathlib import Path

from gbspec.backends import CompilerError
from gbspec.diagnostics import Diagnostic, Severity
from gbspec.exports.c import Library, number, table, unchecked, verify
from gbspec.exports.checking import Quantity, require
from gbspec.exports.compiling import shared_library
from gbspec.exports.fmi.description import Version, build_description, description
from gbspec.exports.fmi.variables import Variables
from gbspec.exports.fmi.verifying import verify as verify_unit
from gbspec.exports.made import ExportOptions, Made, record
from gbspec.exports.subject import Exported

HEADERS = {
    "2": ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    "3": ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
"""Headers of the standard, under the licence that stands in them (BSD, 2 clauses)."""

SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("win", ".dll")}
FLAGS = ("-std=c99", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-s")
CROSS = {
    "x86_64-w64-mingw32-gcc": ("win64", "x86_64-windows", ".dll"),
    "aarch64-linux-gnu-gcc": ("", "aarch64-linux", ".so"),
}
"""Compilers for other platforms: the folder of binaries in FMI 2.0 (empty: it has none) and 3.0, and the suffix."""
SPACE = uuid.UUID("6c2f4c52-6a2b-5d0e-9a7e-0f6a3b1c9d55")
"""The name space of the units' identifiers, which follow from their fingerprints."""


def make(version: Version, exported: Exported, options: ExportOptions) -> Made:
    """A unit of FMI 2.0 or 3.0; compared with the generated module where a compiler is there."""
    library = Library(exported)
    variables = Variables(library)
    name = library.prefix
    token = f"{{{uuid.uuid5(SPACE, f'{version} {exported.fingerprint}')}}}"
    sources = _sources(library, variables, version, token)
    compiled = [f"{name}.c", "gb_core.c", f"fmi{version}.c"]
    files = {"modelDescription.xml": description(variables, version, name, token, compiled)}
    files |= {f"sources/{key}": text.encode() for key, text in sources.items()}
    if version == "3":
        files["sources/buildDescription.xml"] = build_description(name, compiled)
    files["resources/model.gb"] = exported.model.text.encode()
    files["resources/export.json"] = record(exported, f"fmu{version}")
    remarks = []
    checked: tuple[Quantity, ...] = ()
    try:
        folder, suffix = _platform(version)
        binary = _binary(sources, compiled, suffix)
        files[f"binaries/{folder}/{name}{suffix}"] = binary
        files |= _crossed(sources, compiled, name, version, folder)
        checked = (*verify(library), *verify_unit(binary, version, token, variables)) if options.verify else ()
    except CompilerError as problem:
        remarks.append(_without_binary(version, str(problem)))
        remarks += [unchecked(f"fmu{version}", str(problem))] if options.verify else []
    require(f"fmu{version}", checked)
    return Made(files, checked, tuple(remarks))


def _sources(library: Library, variables: Variables, version: Version, token: str) -> dict[str, str]:
    """The C files of a unit by name."""
    name, upper = library.prefix, library.names.upper
    texts = {f"{name}.h": library.header(), f"{name}.c": library.source()}
    for file, target in (("core.h", "gb_core.h"), ("core.c", "gb_core.c"), (f"fmi{version}.c", f"fmi{version}.c")):
        text = _text(file)
        for size in library.sizes:
            text = text.replace(f"PREFIX_{size}", f"{upper}_{size}")
        texts[target] = text.replace("PREFIX", name)
    tables = "\n".join(_tables(library, variables))
    start = number(library.exported.start), number(library.exported.step or 0.0)
    defined = f'#define GB_PARAMETERS {variables.parameters}\n#define GB_TOKEN "{token}"\n'
    programs = library.programs
    defined += f"#define GB_GUARDS {len(programs.conditional)}\n#define GB_TIMED {len(programs.timed)}\n"
    defined += f"#define GB_ALGEBRAICS {library.sizes['ALGEBRAICS']}\n"
    defined += f"#define GB_DELAYS {library.sizes['DELAYS']}\n"
    defined += f"#define GB_START {start[0]}\n#define GB_STEP {start[1]}\n\n"
    texts["gb_core.h"] = texts["gb_core.h"].replace("/* Value references", defined + "/* Value references", 1)
    texts["gb_core.c"] = texts["gb_core.c"].replace("#define GB_NO_ROOM", f"{tables}\n\n#define GB_NO_ROOM", 1)
    kept = (*HEADERS[version], "LICENSE.txt")
    return texts | {name: _text(f"headers/{name}") for name in kept}


def _tables(library: Library, variables: Variables) -> list[str]:
    """Constant tables of the core: starts, nominal values, and places."""
    exported, model = library.exported, library.model
    nominal = []
    for state, value in zip(model.states, exported.states, strict=True):
        bounded = state.range is not None and state.range.bounded
        size = max(abs(state.range.low), abs(state.range.high)) if state.range is not None and bounded else abs(value)
        nominal.append(size if size > 0 else 1.0)
    lines = table("double", "GB_X", map(number, exported.states))
    lines += table("double", "GB_NOMINAL", map(number, nominal))
    lines += table("double", "GB_U", map(number, exported.inputs if len(exported.inputs) else [0.0]))
    if model.delays:
        held = [str(int(item.interpolation == "held")) for item in model.inputs]
        lines += table("int", "GB_HELD", held or ["0"])
    return lines + table("int", "GB_DOSE_STATE", [str(model.state_index[d.state]) for d in model.doses] or ["0"])


def _platform(version: Version) -> tuple[str, str]:
    """The folder of binaries of this platform, and their suffix. Raises CompilerError for one that has no name."""
    if sys.platform not in SYSTEMS:
        raise CompilerError(f"FMI has no name for the platform {sys.platform}")
    system, suffix = SYSTEMS[sys.platform]
    machine = platform.machine().lower()
    wide = sys.maxsize > 2**32
    if version == "2":
        return f"{system}{64 if wide else 32}", suffix
    architecture = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}.get(machine, "x86")
    return f"{architecture}-{'windows' if system == 'win' else system}", suffix


def _binary(sources: dict[str, str], compiled: Sequence[str], suffix: str, compiler: str | None = None) -> bytes:
    with tempfile.TemporaryDirectory(prefix="gbspec-fmu-") as folder:
        target = Path(folder) / f"unit{suffix}"
        flags = tuple(flag for flag in FLAGS if flag != "-s" or sys.platform.startswith("linux"))
        return shared_library(Path(folder), sources, target, compiled, flags, compiler).read_bytes()


def _crossed(
    sources: dict[str, str], compiled: Sequence[str], name: str, version: Version, own: str
) -> dict[str, bytes]:
    """Binaries for other platforms, by the compilers for these that are there."""
    found = {}
    for compiler, (old, new, suffix) in CROSS.items():
        folder, path = (old if version == "2" else new), shutil.which(compiler)
        if path is None or not folder or folder == own:
            continue
        with suppress(CompilerError):
            found[f"binaries/{folder}/{name}{suffix}"] = _binary(sources, compiled, suffix, path)
    return found


def _without_binary(version: Version, reason: str) -> Diagnostic:
    message = f"the unit of FMI {version}.0 has sources only, no binary: {reason}"
    help = "tools that compile units can use it; else install a C compiler and export again"
    return Diagnostic("GB883", message, None, help=help, severity=Severity.WARNING)


@cache
def _text(name: str) -> str:
    return resources.files("gbspec.exports.fmi").joinpath(name).read_text(encoding="utf-8")
