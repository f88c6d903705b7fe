"""Sends data to the console over a local socket, and receives its orders."""
