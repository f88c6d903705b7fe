"""A small file that is replaced atomically: a reader sees the old text or the new one. Reading is
limited in size.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

PRIVATE = 0o600


def replace_file(path: Path, text: str, mode: int = PRIVATE, *, durable: bool = False) -> None:
    """Write the text beside the file and rename it. If the disk refuses, it raises `OSError`, and
    the old file stays.

    The temporary file is always a new one, so a symbolic link of another user is not followed.
    durable: the text is on the disk before the file is renamed, so that it survives a power loss.
    mode: access rights of the new file.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.unlink(missing_ok=True)
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        with open(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)  # its part of the text takes room of a full disk
        raise


def read_small_file(path: Path, most: int = 1000) -> str:
    """Read the UTF-8 text. most: size limit in bytes.

    `OSError` for a link, for a pipe, which would block the reader, and for a larger file;
    ValueError if the content is no text.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    with open(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "is no plain file", str(path))
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"is larger than {most} bytes", str(path))
    return data.decode("utf-8")
