"""Registration: geo-anchors, pose hypotheses and the JNGO optimizer (registration.md)."""
