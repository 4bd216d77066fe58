"""Reads tables to trajectories and writes them: measurements, inputs and doses; and the cases that describe data."""
