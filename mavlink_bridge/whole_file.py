"""A small file that is replaced as a whole: who reads it sees the old text or the new one."""

from __future__ import annotations

import os
from pathlib import Path

PRIVATE = 0o600


def replace_whole(path: Path, text: str, mode: int = PRIVATE, *, durable: bool = False) -> None:
    """Write the text beside the file, and put it in its place; `OSError` where the disk refuses.

    The file beside it is always a new one: a link that somebody laid there is not followed.
    durable: it is on the disk before it is in its place, for what must outlive a loss of power.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.unlink(missing_ok=True)
    with open(
        os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w", encoding="utf-8"
    ) as file:
        file.write(text)
        if durable:
            file.flush()
            os.fsync(file.fileno())
    temporary.replace(path)
