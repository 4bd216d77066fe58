"""Studies: the cases of a `cases.toml` fitted many times and set beside what was published; cross-validation."""
