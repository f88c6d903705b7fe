"""The flight process: what runs, and how its parts are wired."""
