"""Measurements that the README quotes, one command each; see benchmarks/README.md."""

import os

# Runs have one core each, which several threads of NumPy's matrix products would share.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
