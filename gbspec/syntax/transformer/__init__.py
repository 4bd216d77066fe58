"""From the parser's reductions to nodes: one method per rule of the grammar, called bottom up.

Errors that the grammar cannot express (a repeated clause, a comparison used as a number, a reserved name) are reported
here. The nodes of statements are built by their own classes (`gbspec.syntax.statements`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
