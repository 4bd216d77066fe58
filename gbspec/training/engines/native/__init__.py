"""The native engine: the generated and compiled kernel."""
