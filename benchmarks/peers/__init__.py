"""The same training step in other libraries, or by hand: one file each, nothing of gbspec in them but the data."""
