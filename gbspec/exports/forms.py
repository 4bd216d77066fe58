"""The forms of `gbspec export --as`; each imports what it needs when it is made."""

from __future__ import annotations

from gbspec.exports.example import Example
from gbspec.exports.made import ExportOptions, Form, Made
from gbspec.exports.subject import Exported


def _c(exported: Exported, example: Example, options: ExportOptions) -> Made:
    from gbspec.exports.c import make

    return make(exported, example, options)


FORMS = {
    form.name: form for form in (Form("c", "a C99 library without dependencies, as a folder or an archive (.zip)", _c),)
}
"""Every form by its name after `--as`."""
