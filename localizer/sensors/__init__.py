"""What the sensors beside the image err by."""
