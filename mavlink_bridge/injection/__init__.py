"""From vision fixes to what a flight controller fuses, and what became of them."""
