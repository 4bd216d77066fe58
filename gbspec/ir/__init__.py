"""The intermediate representation: the Model and its parts, the verifier, the dump, integration methods."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
