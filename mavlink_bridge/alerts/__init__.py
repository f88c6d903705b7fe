"""Alerts to the operator: identifiers with values. They become text where they leave
the process.
"""
