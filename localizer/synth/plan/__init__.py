"""What stands where in a generated world."""
