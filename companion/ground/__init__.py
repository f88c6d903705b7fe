"""Additional data for ground stations: named values to plot, files of targets."""
