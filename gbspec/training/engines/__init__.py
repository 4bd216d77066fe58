"""Engines: what a fit needs of a problem at a vector, by the torch graph or by the native kernel."""
