"""Fast scenes for training: lit height fields, ray-marched."""
