"""Whole fits: members, workers, clusters, sweeps, and their summaries."""
