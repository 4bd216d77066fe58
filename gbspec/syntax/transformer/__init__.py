"""From the parser's reductions to nodes: one method per rule of the grammar, called bottom up.

Errors that the grammar cannot express (a repeated clause, a comparison used as a number, a reserved name) are reported
here. The nodes of statements are built by their own classes (`gbspec.syntax.statements`).
"""

from gbspec.syntax.transformer.parts import Clause

__all__ = ["Clause"]
