"""Predictions of fitted models, and their initial states."""
