"""Keeps only the newest overviews in a map's folder; each model makes its own."""

from __future__ import annotations

import logging
import os
import re
import shutil
import time
from pathlib import Path

logger = logging.getLogger(__name__)

_KEPT = 3  # the deployment's, and those of models that are compared with it
_KEY = re.compile(r"[0-9a-f]{16}")
_UNFINISHED_S = 86_400.0  # of a process that was cut off; one that writes takes seconds


def mark_used(folder: Path) -> None:
    """Set an overview folder's modification time to now if possible: `drop_old` keeps it."""
    try:
        os.utime(folder)
    except OSError:  # a map that is only read keeps what it has
        return


def drop_old(folder: Path) -> None:
    """Remove all overviews beside this folder but the two used last, and files that a process left
    unfinished over a day ago. Other files stay; a failure is only logged.
    """
    try:
        for left in folder.glob("*.new"):
            if time.time() - left.stat().st_mtime > _UNFINISHED_S:
                left.unlink()
        others = [
            (path.stat().st_mtime, path)
            for path in folder.parent.iterdir()
            if path != folder and _KEY.fullmatch(path.name) and path.is_dir()
            and not path.is_symlink()
        ]  # fmt: skip
        for _, path in sorted(others, reverse=True)[_KEPT - 1 :]:
            logger.info("%s: an overview of a model that is no longer used: removed", path)
            shutil.rmtree(path)
    except OSError as error:
        logger.info("%s: old overviews stay: %s", folder.parent, error)
