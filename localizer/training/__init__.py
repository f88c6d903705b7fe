"""Training of the feature networks (extra `train`): pairs, losses, loop, export. Needs torch."""
