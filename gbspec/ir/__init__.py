"""The intermediate representation: the Model and its parts, the verifier, the dump, integration methods."""
