"""Fast scenes for training: lit height fields, rendered by ray marching."""
