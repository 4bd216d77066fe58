"""From text to a syntax tree: file reading, parser, statements, names, formatter. Only this package imports lark."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
