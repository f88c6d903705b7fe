"""What light, weather and a camera do to a rendered image."""
