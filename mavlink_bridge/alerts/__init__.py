"""Alerts: what the operator is told, as identifiers with values; text is made at the edge."""
