"""gbspec: a declarative compiler for gray-box dynamical models."""

__version__ = "0.1.0"
