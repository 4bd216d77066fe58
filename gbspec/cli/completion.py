"""Completion scripts for bash, zsh and fish, made from the commands.

A script holds all words, so that nothing is started while a line is typed: names of commands, options, the words among
which an option chooses, names of bundled models; files otherwise.
"""

from __future__ import annotations

import shlex
import typing
from collections.abc import Mapping
from dataclasses import dataclass

import typer

from gbspec.cli.flags import choices
from gbspec.cli.frame import Command

HELP_FLAGS = ("--help", "-h")
"""The options that every command has without declaring them."""


@dataclass(frozen=True)
class Words:
    """What can follow a command: its options with the words for their values, and the words for its arguments.

    The values of a switch are None; those of an option with a free value, such as a file, are empty.
    """

    meaning: str
    flags: Mapping[str, tuple[str, ...] | None]
    arguments: tuple[str, ...]


def words(command: Command, models: tuple[str, ...]) -> Words:
    """The words of one command; arguments called MODEL may be bundled models."""
    flags: dict[str, tuple[str, ...] | None] = dict.fromkeys(HELP_FLAGS)
    arguments: list[str] = []
    for parameter in command.call.__signature__.parameters.values():  # type: ignore[attr-defined]  # set by `command`
        kind, shown = typing.get_args(parameter.annotation)[:2]
        if isinstance(shown, typer.models.ArgumentInfo):
            arguments += models if "MODEL" in str(shown.metavar) else choices(parameter.annotation)
            continue
        # in an annotation typer takes the first spelling for the default, until the command is built
        for spelling in (s for s in (shown.default, *shown.param_decls) if str(s).startswith("-")):
            values = None if kind is bool else choices(parameter.annotation)
            flags |= dict.fromkeys(spelling.split("/"), values)
    return Words(command.help.partition("\n")[0], flags, tuple(arguments))


def script(shell: str, commands: Mapping[str, Words]) -> str:
    """The script for a shell, one of `SHELLS`."""
    return SHELLS[shell](commands)


def _bash(commands: Mapping[str, Words]) -> str:
    return "\n".join(
        [
            "# bash completion of gbspec; made by `gbspec completion bash`",
            "_gbspec() {",
            "    local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} found=",
            '    if [[ $COMP_CWORD -eq 1 ]]; then COMPREPLY=($(compgen -W "$_gbspec_commands" -- "$word")); return; fi',
            '    case "${COMP_WORDS[1]} $before" in',
            *(f'        {name}" "{flag}) found={_quoted(values)};;' for name, flag, values in _choosing(commands)),
            *(f'        {name}" "{flag}) COMPREPLY=(); return;;' for name, flag in _free(commands)),
            '        *) case "${COMP_WORDS[1]} $word" in',
            *(f'            {name}" "-*) found={_quoted(w.flags)};;' for name, w in commands.items()),
            *(f'            {name}" "*) found={_quoted(w.arguments)};;' for name, w in commands.items() if w.arguments),
            "        esac;;",
            "    esac",
            '    COMPREPLY=($(compgen -W "$found" -- "$word"))',
            "}",
            f"_gbspec_commands={_quoted(commands)}",
            "complete -o bashdefault -o default -F _gbspec gbspec",
            "",
        ]
    )


def _zsh(commands: Mapping[str, Words]) -> str:
    described = " ".join(shlex.quote(f"{name}:{found.meaning}") for name, found in commands.items())
    lines = [
        "#compdef gbspec",
        "# zsh completion of gbspec; made by `gbspec completion zsh`",
        "_gbspec() {",
        "    local -a commands",
        f"    commands=({described})",
        "    if (( CURRENT == 2 )); then _describe command commands; return; fi",
        '    case "$words[2] $words[CURRENT-1]" in',
        *(f'        {name}" "{flag}) compadd -- {" ".join(v)}; return;;' for name, flag, v in _choosing(commands)),
        *(f'        {name}" "{flag}) _files; return;;' for name, flag in _free(commands)),
        "    esac",
        '    case "$words[2] $PREFIX" in',
        *(f'        {name}" "-*) compadd -- {" ".join(w.flags)}; return;;' for name, w in commands.items()),
        *(f'        {n}" "*) compadd -- {" ".join(w.arguments)};;' for n, w in commands.items() if w.arguments),
        "    esac",
        "    _files",
        "}",
        'if [[ $funcstack[1] == _gbspec ]]; then _gbspec "$@"; else compdef _gbspec gbspec; fi',
    ]
    return "\n".join([*lines, ""])


def _fish(commands: Mapping[str, Words]) -> str:
    lines = ["# fish completion of gbspec; made by `gbspec completion fish`"]
    for name, found in commands.items():
        said = shlex.quote(found.meaning)
        lines.append(f"complete -c gbspec -f -n __fish_use_subcommand -a {name} -d {said}")
        used = f"complete -c gbspec -n '__fish_seen_subcommand_from {name}'"
        for flag, values in found.flags.items():
            spelled = f"-l {flag[2:]}" if flag.startswith("--") else f"-s {flag[1:]}"
            value = "" if values is None else f" -x -a {_quoted(values)}" if values else " -r"
            lines.append(f"{used} {spelled}{value}")
        if found.arguments:
            lines.append(f"{used} -a {_quoted(found.arguments)}")
    return "\n".join([*lines, ""])


SHELLS = {"bash": _bash, "zsh": _zsh, "fish": _fish}
"""The maker of the script for each shell."""


def _choosing(commands: Mapping[str, Words]) -> list[tuple[str, str, tuple[str, ...]]]:
    """The options that choose among words: command, option, words."""
    return [(n, flag, values) for n, found in commands.items() for flag, values in found.flags.items() if values]


def _free(commands: Mapping[str, Words]) -> list[tuple[str, str]]:
    """The options with a free value: command, option."""
    return [(n, flag) for n, found in commands.items() for flag, values in found.flags.items() if values == ()]


def _quoted(found: typing.Iterable[str]) -> str:
    return shlex.quote(" ".join(found))
