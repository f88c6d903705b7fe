"""What the operator's page costs a flight, and how late it shows a picture."""
