"""Whether `companion plan` tells beforehand where registration fails, and how good it is."""
