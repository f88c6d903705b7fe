"""Effects of light, weather and camera on a rendered image."""
