"""Profile likelihoods of learned constants."""
