"""Where a fit starts from: curves, slopes, gradient matching, search, initial states."""
