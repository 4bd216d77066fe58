"""ONNX graphs of a model, with a batch dimension, in double or single precision."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
