"""The form `c`: a C99 library as a folder or an archive."""

from __future__ import annotations

from gbspec.backends import CompilerError
from gbspec.diagnostics import Diagnostic, Severity
from gbspec.exports.c.library import Library
from gbspec.exports.c.main import cmake, main
from gbspec.exports.c.verifying import verify
from gbspec.exports.checking import require
from gbspec.exports.example import Example
from gbspec.exports.made import ExportOptions, Made, record
from gbspec.exports.subject import Exported


def make(exported: Exported, example: Example, options: ExportOptions) -> Made:
    """The files of the library; compared with the generated module where a compiler is there."""
    library = Library(exported)
    name = library.prefix
    texts = {
        f"{name}.h": library.header(),
        f"{name}.c": library.source(),
        "main.c": main(library, example),
        "CMakeLists.txt": cmake(library),
        "model.gb": exported.model.text,
    }
    files = {key: text.encode() for key, text in texts.items()} | {"export.json": record(exported, "c")}
    if not options.verify:
        return Made(files)
    try:
        checked = tuple(verify(library))
    except CompilerError as problem:
        return Made(files, remarks=(unchecked("c", str(problem)),))
    require("c", checked)
    return Made(files, checked)


def unchecked(form: str, reason: str) -> Diagnostic:
    """The warning (GB882) that an export was not compared with the generated module."""
    message = f"the export as `{form}` was not compared with the generated module: {reason}"
    help = "install a C compiler, or test the export where it is used"
    return Diagnostic("GB882", message, None, help=help, severity=Severity.WARNING)
