"""One module for each kind of statement: its node, how it is read, and what every other part of gbspec asks of it.

`gbspec.syntax.ast` lists them and is where they are imported from; `base` says what a statement must answer.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
