"""What the commands, the Python interface and the studies are made of, by subject.

`models` opens models and runs and compiles them, `tables` makes and reads data, `fitting` trains, `analysing` asks what
a model or a run does, `reporting` draws and writes it down. Nothing here computes: each function brings together what
the packages below have. These are imported when they are used, so that a command loads what it needs alone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
