"""What registration could give at a place where nobody has flown yet: forecasts from the map."""
