"""The version of gbspec: in a separate module, so that it can be recorded without importing the whole package."""

__version__ = "0.1.0"
