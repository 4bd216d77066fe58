"""The same training step in other libraries or by hand: one file each, which use only the data from gbspec."""
