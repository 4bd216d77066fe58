"""The Kalman filter: moments, likelihood, fits."""
