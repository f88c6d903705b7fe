"""Files that users, records and maps name, read without waiting for ever and within bounds; a
user's text whatever editor saved it; the files that a user means by a folder.
"""

from __future__ import annotations

import codecs
import errno
import os
import stat
from collections.abc import Collection, Iterable
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
    """A plain file's text, lines as they end there; see `plain_bytes` and `as_text`."""
    return as_text(plain_bytes(path, most))


def as_text(data: bytes) -> str:
    """UTF-8, or UTF-16 as its byte order mark says, which is left out: editors of Windows write
    one. UnicodeDecodeError for another encoding.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        error.reason += "; save the file as UTF-8"
        raise


def legible(data: bytes) -> str:
    """As `as_text`; in another encoding, what is not ASCII is replaced."""
    try:
        return as_text(data)
    except UnicodeDecodeError:
        return data.decode("utf-8-sig", "replace")


def visible(paths: Iterable[Path]) -> list[Path]:
    """Those that a user means, by name: a Mac that copies to a stick puts a ``._NAME`` beside each
    NAME (AppleDouble), and a ``.NAME`` is hidden.
    """
    return sorted(p for p in paths if not p.name.startswith("."))


def files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """The files of a folder that end so (lower case, with the dot) and are not hidden, by name."""
    return visible(p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file())
