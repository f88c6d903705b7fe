"""What is asked of the console beside a flight."""

# Of a core, %, without a page and with one; a picture's age when painted, ms; pictures a second.
LIMITS = {"no page": 3.0, "one page": 15.0, "age_ms": 300.0, "frames_per_s": 5.0}
