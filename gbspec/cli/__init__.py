"""The command line: one module per command, one frame for errors, output and exit statuses."""

from gbspec.cli.app import main

__all__ = ["main"]
