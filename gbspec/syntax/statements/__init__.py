"""One module for each kind of statement: its node, how it is built, and its entry in the tables of the language.

`gbspec.syntax.ast` lists them, and others import them from there; `base` defines their interface.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
