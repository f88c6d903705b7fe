"""Files that users, records and maps name, read without waiting for ever and within bounds."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

MOST_BYTES = 1 << 28  # of text and pictures; what is longer is another file, given by mistake


def plain_bytes(path: Path, most: int | None = MOST_BYTES) -> bytes:
    """A plain file's content. most: bytes; None: whatever there is.

    OSError for a pipe, whose reader waits for who writes into it, for a device, which may have no
    end, and for more than `most` bytes.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with open(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "is not a plain file", str(path))
        data = file.read(-1 if most is None else most + 1)
    if most is not None and len(data) > most:
        raise OSError(errno.EFBIG, f"is larger than {most >> 20} MiB", str(path))
    return data


def plain_text(path: Path, most: int | None = MOST_BYTES) -> str:
    """A plain file's text, UTF-8, lines as they end there; see `plain_bytes`."""
    return plain_bytes(path, most).decode("utf-8")
