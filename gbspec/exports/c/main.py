"""`main.c`, which simulates one trajectory and prints it as a table, and the CMake file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.data import DoseEvents, Signal
from gbspec.exports.c.library import Library
from gbspec.exports.c.printer import ascii_text, number, table
from gbspec.exports.example import Example

FINE = 2000
"""Steps of the whole trajectory, at least: the difference to an adaptive solver is then small."""

CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project({0} C)
set(CMAKE_C_STANDARD 99)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
add_library({0} {0}.c)
target_include_directories({0} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
if(UNIX)
  target_link_libraries({0} PUBLIC m)
endif()
add_executable({0}_main main.c)
target_link_libraries({0}_main {0})
"""


def cmake(library: Library) -> str:
    """The CMake file."""
    return CMAKE.format(library.prefix)


def main(library: Library, example: Example) -> str:
    """A program that prints the channels of a trajectory."""
    prefix, upper, model = library.prefix, library.names.upper, library.model
    span = float(example.times[-1]) - example.start
    step = min(library.exported.step or span, span / FINE) or 1.0
    columns = ["trajectory", model.time.name, *(channel.name for channel in model.channels)]
    said = f"   The same table: {ascii_text(example.command)}" if example.command else "   From the initial values."
    lines = [f"/* Simulates one trajectory of {ascii_text(model.name)} and prints its channels.", said, "*/", ""]
    lines += [f'#include "{prefix}.h"', "", "#include <stdio.h>", ""]
    lines += table("double", "START", map(number, example.x0)) + table("double", "TIMES", map(number, example.times))
    lines += _courses("INPUT", example.inputs, prefix) + _courses("DOSE", example.doses, prefix)
    count = len(example.times)
    width = max(len(model.channels), 1)
    lines += ["", "int main(void) {", f"    double channels[{count} * {width}];", f"    {prefix}_parameters p;"]
    lines += [f"    static {prefix}_past past;"] * bool(model.delays)
    lines += ["    int i, j, status;", f"    {prefix}_defaults(&p);"]
    for member, value in zip(library.names.conditions, example.condition, strict=True):
        lines.append(f"    p.{member} = {number(float(value))};")
    given = [("INPUT" if model.inputs else "NULL"), ("DOSE" if model.doses else "NULL")]
    lines.append(
        f"    status = {prefix}_simulate(&p, {number(example.start)}, START, {given[0]}, {given[1]}, {count}, TIMES, "
        f"{number(step)}, NULL, {'channels' if model.channels else 'NULL'}{', &past' if model.delays else ''});"
    )
    header = ascii_text(",".join(columns))
    lines += ["    if (status) return status;", f'    printf("{header}\\n");', f"    for (i = 0; i < {count}; i++) {{"]
    lines += ['        printf("1,%.17g", TIMES[i]);']
    lines += [f'        for (j = 0; j < {upper}_CHANNELS; j++) printf(",%.17g", channels[i * {width} + j]);']
    return "\n".join([*lines, '        printf("\\n");', "    }", "    return 0;", "}", ""])


def _courses(name: str, courses: Sequence[Signal | DoseEvents], prefix: str) -> list[str]:
    lines = []
    entries = []
    for i, one in enumerate(courses):
        values = one.values if isinstance(one, Signal) else one.amounts
        times, values = (array if len(array) else np.zeros(1) for array in (one.times, values))
        lines += table("double", f"{name}_{i}_TIMES", map(number, times))
        lines += table("double", f"{name}_{i}_VALUES", map(number, values))
        entries.append(f"{{{len(one.times)}, {name}_{i}_TIMES, {name}_{i}_VALUES}}")
    if entries:
        lines.append(f"static const {prefix}_course {name}[{len(entries)}] = {{{', '.join(entries)}}};")
    return lines
