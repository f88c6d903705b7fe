"""What ground stations show beside the camera protocol: figures to plot, files of targets."""
