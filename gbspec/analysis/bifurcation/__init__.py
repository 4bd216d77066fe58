"""Branches of steady states and cycles, their special points and spectra."""
