"""One self-contained HTML page about a flight, a demo or an evaluation."""
