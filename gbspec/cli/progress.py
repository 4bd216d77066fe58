"""The progress of training on standard error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from gbspec.cli.output import Output
from gbspec.report import progress_on
from gbspec.training import Progress, Silent


@contextmanager
def shown(output: Output) -> Iterator[Progress]:
    """A progress display: a live one on a terminal, lines elsewhere, none with `--quiet`."""
    if output.quiet:
        yield Silent()
        return
    with progress_on(output.console(), output.say) as progress:
        yield progress
