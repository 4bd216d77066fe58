"""Errors of fits: on data, at smaller steps, and against a truth."""
