"""What a model says: simulation, validation, steady states, eigenvalues, bifurcations and limit cycles."""
