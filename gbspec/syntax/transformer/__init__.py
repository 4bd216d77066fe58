"""From the parser's reductions to nodes: one method a rule of the grammar, called bottom up with what the rule matched.

What a rule cannot say (a clause twice, a comparison used as a number, a refused name) is found here, with its place.
The rules of statements are read by the statements' own classes.
"""

from gbspec.syntax.transformer.parts import Clause

__all__ = ["Clause"]
