"""Text to tree: reading, statements, the parser, names, and the formatter; the only importer of lark."""

from gbspec.syntax.parser import parse, parse_expression, read_source

__all__ = ["parse", "parse_expression", "read_source"]
