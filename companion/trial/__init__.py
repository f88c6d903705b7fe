"""``companion try``: localize recorded footage over a map and judge whether vision works there."""
