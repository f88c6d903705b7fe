"""Reads files without blocking and with size limits, in any usual text encoding, and lists a
folder's visible files.
"""

from __future__ import annotations

import codecs
import errno
import os
import stat
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

MOST_BYTES = 1 << 28  # of text and pictures; what is longer is another file, given by mistake


@contextmanager
def open_plain(path: Path) -> Iterator[BufferedReader]:
    """A plain file, opened for reading. OSError for a pipe, which may block the reader, and for a
    device, which may have no end.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "is not a plain file", str(path))
        yield file


def plain_bytes(path: Path, most: int | None = MOST_BYTES) -> bytes:
    """Content of a plain file. most: size limit in bytes; None: no limit.

    OSError as `open_plain`, and for more than `most` bytes.
    """
    with open_plain(path) as file:
        data = file.read(-1 if most is None else most + 1)
    if most is not None and len(data) > most:
        raise OSError(errno.EFBIG, f"is larger than {most >> 20} MiB", str(path))
    return data


def plain_text(path: Path, most: int | None = MOST_BYTES) -> str:
    """Text of a plain file; limit and errors as `plain_bytes`, encodings as `as_text`."""
    return as_text(plain_bytes(path, most))


def as_text(data: bytes) -> str:
    """Decode UTF-8, or UTF-16 with a byte order mark, which is removed. UnicodeDecodeError for
    another encoding.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        error.reason += "; save the file as UTF-8"
        raise


def decode_lenient(data: bytes) -> str:
    """Decode text as `as_text`; in another encoding, non-ASCII characters are replaced."""
    try:
        return as_text(data)
    except UnicodeDecodeError:
        return data.decode("utf-8-sig", "replace")


def without_hidden(paths: Iterable[Path]) -> list[Path]:
    """The paths, sorted, without those whose name begins with a dot: hidden files, and macOS's
    ``._NAME`` files (AppleDouble).
    """
    return sorted(p for p in paths if not p.name.startswith("."))


def files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """A folder's visible files with these suffixes, sorted by name; subfolders are not searched.
    suffixes: lower case, with the dot; the files' own may be upper case.
    """
    return without_hidden(
        p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file()
    )
