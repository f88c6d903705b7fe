"""Training pairs: generation, shards, batches."""
