"""Data for the console over a local socket, and the orders that the console may send."""
