"""From the parser's reductions to nodes: one method a rule of the grammar, called bottom up with what the rule matched.

What a rule cannot say (a clause twice, a comparison used as a number, a refused name) is found here, with its place.
The rules of statements are read by the statements' own classes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
