"""Simulation of data from models."""
