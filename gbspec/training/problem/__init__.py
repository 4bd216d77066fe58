"""What is fitted: data packed for stepping, the trainable vector, and the definition of the residual."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
