"""Figures: each module builds the description of one kind of figure, from a run or from a result."""
