"""Backends: from one Model to text in other languages and to functions; each a folder, listed in `registry`."""
