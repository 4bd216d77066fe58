"""The language server: what an editor asks about a `.gb` file; only `server` and `messages` speak the protocol."""
