"""The operator's page: a process of its own, which the flight does not notice."""
