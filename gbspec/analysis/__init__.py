"""Analyses of a model: simulation, validation, steady states, eigenvalues, bifurcations and limit cycles."""
