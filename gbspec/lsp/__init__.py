"""The language server for `.gb` files; only `server` and `messages` depend on the protocol."""
