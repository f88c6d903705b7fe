"""Seeds of generated worlds that training may use."""

from __future__ import annotations

FIRST_WORLD_SEED = 1000  # those below belong to demos and tests
