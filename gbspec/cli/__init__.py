"""The command line: one module a command, one frame for errors, output and exit statuses."""

from gbspec.cli.app import main

__all__ = ["main"]
