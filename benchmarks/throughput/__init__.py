"""How fast the dual-thread engine is, and where its processor time goes."""
