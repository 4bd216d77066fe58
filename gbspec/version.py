"""The version of gbspec: in a module of its own, so that those who write it down do not import the package's door."""

__version__ = "0.1.0"
