"""The forms of `gbspec export --as`; each imports what it needs when it is made."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.exports.made import Form

if TYPE_CHECKING:
    from gbspec.exports.example import Example
    from gbspec.exports.made import ExportOptions, Made
    from gbspec.exports.subject import Exported


def _c(exported: Exported, example: Example, options: ExportOptions) -> Made:
    from gbspec.exports.c import make

    return make(exported, example, options)


def _fmu2(exported: Exported, example: Example, options: ExportOptions) -> Made:
    from gbspec.exports.fmi import make

    return make("2", exported, options)


def _fmu3(exported: Exported, example: Example, options: ExportOptions) -> Made:
    from gbspec.exports.fmi import make

    return make("3", exported, options)


def _onnx(exported: Exported, example: Example, options: ExportOptions) -> Made:
    from gbspec.exports.onnx import make

    return make(exported, options)


def _sbml(exported: Exported, example: Example, options: ExportOptions) -> Made:
    from gbspec.exports.sbml import make

    return make(exported, example, options)


def _petab(exported: Exported, example: Example, options: ExportOptions) -> Made:
    from gbspec.exports.petab import make

    return make(exported, example, options)


FORMS = {
    form.name: form
    for form in (
        Form("c", "a C99 library without dependencies, as a folder or an archive (.zip)", _c, simulates=True),
        Form("fmu", "the same as fmu2, which most tools import", _fmu2, packed=True),
        Form("fmu2", "a functional mock-up unit of FMI 2.0, for model exchange and co-simulation", _fmu2, packed=True),
        Form("fmu3", "the same of FMI 3.0", _fmu3, packed=True),
        Form("petab", "a PEtab 2 problem with the model in SBML and the tables of `--data`", _petab, tabled=True),
        Form("sbml", "SBML Level 3, as one file (.xml), a folder or an archive (.zip)", _sbml, single=".xml"),
        Form("onnx", "ONNX graphs, as a folder or an archive (.zip), or one (.onnx)", _onnx, single=".onnx"),
    )
}
"""Every form by its name after `--as`."""
