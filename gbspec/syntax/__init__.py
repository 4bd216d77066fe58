"""Text to tree: reading, statements, the parser, names, and the formatter; the only importer of lark."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
