"""Folders of cached files that may be deleted at any time."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder(kind: str) -> Path:
    """The cache folder with the name `kind`, in the folder that the environment variable
    PILOT_CACHE names or else in the user's cache folder. It may not exist yet.
    """
    base = os.environ.get("PILOT_CACHE")
    if base:
        return Path(base) / kind
    user = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return Path(user).expanduser() / "pilot-companion" / kind
