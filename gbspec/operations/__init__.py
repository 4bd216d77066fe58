"""The operations behind the commands, the Python interface and the studies, by subject.

`models` opens and compiles models and runs, `tables` creates and reads data, `fitting` trains, `analysing` analyses
models and runs, `reporting` makes figures and reports. No numerical work is done here: each function combines those of
lower packages, which it imports when called, so that a command loads only what it needs.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
