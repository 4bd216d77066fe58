"""A model as a dynamical system: its right-hand side in casadi, steady states."""
