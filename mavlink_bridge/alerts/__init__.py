"""Alerts to the operator: identifiers with values. Text is made where they leave the process."""
