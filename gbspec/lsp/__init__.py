"""The language server: what an editor asks about a `.gb` file; only `server` and `messages` speak the protocol."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
