"""Optimisers: Levenberg-Marquardt and its normal equations, Adam, L-BFGS, and priors."""
