"""The extended Kalman filter: moments, likelihood, fits."""
