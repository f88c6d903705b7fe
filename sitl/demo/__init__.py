"""The GNSS-denied demo flight and its report."""
