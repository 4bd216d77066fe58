"""The gallery: cases that are executed, each with its figure and what was measured."""
