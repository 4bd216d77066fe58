"""Places in texts, diagnostics, the catalogue of codes, and rendering as text and JSON."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
