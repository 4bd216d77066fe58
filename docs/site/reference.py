"""The pages of the reference that are generated: commands, codes of diagnostics, Python interface."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import click
import typer

import gbspec
from gbspec.cli.app import COMMANDS, build
from gbspec.cli.flags import default, flagged
from gbspec.data import SimulateOptions
from gbspec.diagnostics.catalogue import Entry, entries
from gbspec.studies import StudyOptions
from gbspec.training import TrainOptions

OPTIONS = (TrainOptions, SimulateOptions, StudyOptions)
"""The dataclasses of options that keyword arguments are the fields of."""

TOPICS = {
    "syntax": "Text and syntax",
    "names": "Names",
    "units": "Units",
    "balances": "Balances, starts, ranges",
    "contracts": "Contracts and postulates",
    "conservation": "Conservation laws",
    "learning": "What is learned",
    "data": "Tables",
    "runs": "Runs and training",
    "analysis": "Analysis",
    "commands": "Commands",
}


def pages() -> dict[str, str]:
    """The text of each generated page by its file name."""
    return {"commands.md": commands(), "diagnostics.md": diagnostics(), "python.md": python()}


def commands() -> str:
    """Every command as its `--help` has it."""
    parts = [
        "# Commands\n",
        "This page is made from the help of the commands, which `gbspec COMMAND --help` shows. Every command has"
        " `--quiet` (say nothing but results and errors) and `--json` (one JSON document on standard output). The exit"
        " status is 0 (done), 1 (the input is wrong), 2 (wrong usage), 3 (the computation failed), 70 (a defect of"
        " gbspec) or 130 (interrupted).\n",
    ]
    group = typer.main.get_command(build())
    assert isinstance(group, click.Group) or hasattr(group, "commands")
    for name in COMMANDS:
        parts += command(name, group.commands[name])
    return "\n".join(parts)


def command(name: str, made: Any) -> Iterator[str]:
    """One command: what it does, its arguments and options by group, examples."""
    yield f"## gbspec {name}\n"
    yield prose(made.help or "") + "\n"
    shown = [one for one in made.params if "--help" not in one.opts and not {"--quiet", "--json"} & set(one.opts)]
    panels: dict[str, list[Any]] = {}
    for one in shown:
        panels.setdefault(getattr(one, "rich_help_panel", None) or "", []).append(one)
    for panel, members in panels.items():
        yield f"| {panel or 'argument or option'} | |\n|---|---|"
        yield "\n".join(row(one) for one in members) + "\n"
    examples = [line.strip() for line in (made.epilog or "").splitlines() if line.strip().startswith("gbspec")]
    if examples:
        yield "\n".join(["```sh", *examples, "```\n"])


def row(one: Any) -> str:
    """A line of the table for an argument or an option."""
    metavar = (one.metavar or "").strip()
    if one.param_type_name == "argument":
        spelled = f"`{metavar or one.name.upper()}`"
    else:
        spelled = ", ".join(f"`{opt}`" for opt in (*one.opts, *one.secondary_opts))
        spelled += f" `{metavar}`" if metavar else ""
    notes = [prose(one.help or "")]
    if one.required:
        notes.append("*Required.*")
    elif getattr(one, "show_default", False) and one.default not in (None, False, (), [], ""):
        value = " ".join(map(str, one.default)) if isinstance(one.default, list | tuple) else one.default
        notes.append(f"Default: `{value}`.")
    return f"| {barred(spelled)} | {barred(' '.join(notes))} |"


def cell(text: str) -> str:
    """Help text in a table."""
    return barred(prose(text))


def barred(text: str) -> str:
    """Text whose bars do not end a cell."""
    return text.replace("|", chr(92) + "|")


def prose(text: str) -> str:
    """Help text as Markdown: words in angle brackets and asterisks stay what they are."""
    return (
        re.sub(r"(?<!`)([<>*_])(?!`)", r"\\\1", inspect.cleandoc(text)) if "`" not in text else inspect.cleandoc(text)
    )


def diagnostics() -> str:
    """Every code with its explanation and both examples, by topic."""
    found: dict[str, list[Entry]] = {}
    for entry in entries().values():
        found.setdefault(entry.topic, []).append(entry)
    parts = [
        "# Codes of diagnostics\n",
        "Every message of gbspec has a code. This page is made from the catalogue, which `gbspec explain CODE` shows. A"
        " warning can be [allowed](../language.md#allow) by its code.\n",
    ]
    for topic in sorted(found, key=lambda topic: list(TOPICS).index(topic) if topic in TOPICS else len(TOPICS)):
        parts.append(f"## {TOPICS.get(topic, topic.capitalize())}\n")
        for entry in found[topic]:
            parts += [f"### {entry.code}\n", f"**{entry.title}**\n", entry.explanation + "\n"]
            for title, text in (("Wrong", entry.wrong), ("Right", entry.right)):
                if text.strip():
                    parts += [f"{title}:\n", f"```\n{text}\n```\n"]
    return "\n".join(parts)


def python() -> str:
    """The public names with their docstrings, as Sphinx's autodoc reads them."""
    parts = [
        "# Python interface\n",
        "This page is made from the docstrings of the package. The names are those of `gbspec.__all__`; the methods are"
        " named like the [commands](commands.md). [From Python](../howto/python.md) has examples.\n",
        "## Functions\n",
    ]
    names = [name for name in gbspec.__all__ if not name.startswith("__")]
    functions = [name for name in names if inspect.isfunction(getattr(gbspec, name))]
    classes = [name for name in names if inspect.isclass(getattr(gbspec, name))]
    parts += [directive("autofunction", place(name)) for name in functions]
    parts += ["## Models, runs and other objects\n"]
    parts += [directive("autoclass", place(name), "members", "show-inheritance") for name in classes]
    parts += ["## Options\n", "The fields of these classes are keyword arguments of the methods above.\n"]
    parts += [fields(options) for options in OPTIONS]
    return "\n".join(parts)


def fields(options: type) -> str:
    """The fields of a dataclass of options: name, default, meaning."""
    rows = [
        f"| `{one.name}` | `{default(one)!r}` | {cell(one.metadata.get('help') or '')} |" for one in flagged(options)
    ]
    said = (inspect.getdoc(options) or "").partition("\n\n")[0]
    return "\n".join(
        [f"### {options.__name__}\n", said + "\n", "| field | default | meaning |", "|---|---|---|", *rows, ""]
    )


def place(name: str) -> str:
    """Where a public name is defined."""
    return f"{getattr(gbspec, name).__module__}.{name}"


def directive(kind: str, name: str, *flags: str) -> str:
    """A directive of reStructuredText within a page."""
    return "\n".join(["```{eval-rst}", f".. {kind}:: {name}", *(f"   :{flag}:" for flag in flags), "```\n"])
