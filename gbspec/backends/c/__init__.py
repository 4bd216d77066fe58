"""C of right-hand side, Jacobian, observations and one step, made by casadi."""

from gbspec.backends.c.source import c_code, step

__all__ = ["c_code", "step"]
