"""Measurements that the README quotes, one command each; see benchmarks/README.md."""
