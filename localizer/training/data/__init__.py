"""Training pairs: made, kept in shards, batched."""
