"""Which stages run, in which order, and what they work with."""
