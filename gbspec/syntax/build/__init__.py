"""From the parser's reductions to nodes: one method a rule of the grammar, called bottom up with what the rule matched.

What a rule cannot say (a clause twice, a comparison used as a number, a refused name) is found here, with its place.
"""

from gbspec.syntax.build.parts import Clause
from gbspec.syntax.build.statements import Builder

__all__ = ["Builder", "Clause"]
