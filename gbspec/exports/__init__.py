"""Models and runs in forms that other programs run: a C library, functional mock-up units, ONNX graphs.

Every form is made from the same lists of operations (`programs`), and compared with the generated module before it is
written (`checking`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
