"""The operator's page, in its own process, which cannot slow the flight down."""
