"""Data simulated from models."""
