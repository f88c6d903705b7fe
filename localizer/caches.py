"""Folders of cached files that may be deleted at any time."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder(kind: str) -> Path:
    """Cache folder of one kind, below `PILOT_CACHE` or else the user's cache folder."""
    base = os.environ.get("PILOT_CACHE")
    if base:
        return Path(base) / kind
    user = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return Path(user).expanduser() / "pilot-companion" / kind
