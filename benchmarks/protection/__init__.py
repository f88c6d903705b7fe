"""How wrong positions are when the installation is as a calibration leaves it."""
