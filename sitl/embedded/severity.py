"""MAV_SEVERITY of the status texts."""

from __future__ import annotations

CRITICAL, WARNING, INFO = 2, 4, 6
