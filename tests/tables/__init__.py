"""Functions given by points."""
