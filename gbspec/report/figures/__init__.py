"""Figures: a module each, from what is known of a run, or from a result, to the description of what is drawn."""
