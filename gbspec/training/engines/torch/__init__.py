"""The torch engine: the reference, for every model and every device."""
