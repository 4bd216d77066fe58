"""From text to a syntax tree: file reading, parser, statements, names, formatter. Only this package imports lark."""

from gbspec.syntax.parser import parse, parse_expression, read_source

__all__ = ["parse", "parse_expression", "read_source"]
