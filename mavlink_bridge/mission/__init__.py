"""What a mission's items mean: the places that are flown to, and where the camera looks."""
