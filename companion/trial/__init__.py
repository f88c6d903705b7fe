"""``companion try``: recorded footage over a map, and the verdict whether vision works there."""
