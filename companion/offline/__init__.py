"""Analysis after the flight: replay and plots."""
