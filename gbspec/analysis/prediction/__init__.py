"""Predictions of fitted models, and the initial states that they start from."""
