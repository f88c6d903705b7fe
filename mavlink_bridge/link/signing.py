"""MAVLink 2 signing: the key file, and one signing state per sending component.

https://mavlink.io/en/guide/message_signing.html
"""

from __future__ import annotations

import errno
import os
import stat
import time
from pathlib import Path
from typing import Any

from mavlink_bridge.atomic_file import replace_file
from mavlink_bridge.errors import SigningKeyError

_SIGNING_EPOCH_S = 1420070400  # 2015-01-01 UTC
_TICKS_PER_S = 100_000  # time stamps count 10 microseconds
_LONGEST_TEXT = 1024


def load_key(path: Path) -> bytes:
    """Read the 32-byte key from a file of 64 hexadecimal digits that only its owner can read.
    `SigningKeyError` for every other file.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # a pipe would be waited for without end
            raise SigningKeyError(f"{path}: signing key is no file")
        with path.open(encoding="utf-8-sig") as file:
            text = file.read(_LONGEST_TEXT).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise SigningKeyError(f"{path}: signing key cannot be read ({error})") from error
    if stat.S_IMODE(mode) & 0o077:
        raise SigningKeyError(f"{path}: signing key is readable by others; chmod 600 it")
    try:
        key = bytes.fromhex(text)
    except ValueError as error:
        raise SigningKeyError(f"{path}: signing key must be 64 hexadecimal digits") from error
    if len(key) != 32:
        raise SigningKeyError(f"{path}: signing key has {len(key)} bytes, needs 32")
    if not any(key):
        raise SigningKeyError(
            f"{path}: signing key is zero, which ArduPilot takes for no signing; make a random one"
        )
    return key


def create_key(path: Path) -> bytes:
    """Write a new random key to a new file of mode 0600 and return it; OSError if it exists, or
    cannot be written: then there is none.
    """
    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    key = os.urandom(32)
    replace_file(path, key.hex() + "\n", durable=True)
    return key


def signing_timestamp(unix_time_s: float | None = None) -> int:
    """Signing time stamp of a time (now if None): 10 microsecond ticks since 2015-01-01 UTC.

    0 before that: a computer without a battery clock may wake up in 1970.
    """
    now = time.time() if unix_time_s is None else unix_time_s
    return max(int((now - _SIGNING_EPOCH_S) * _TICKS_PER_S), 0)


def enable(mav: Any, key: bytes, link_id: int) -> None:
    """Make a pymavlink `MAVLink` sign what it sends with `key` (32 bytes) and this link id, and
    reject frames that are unsigned or not signed with the key.
    """
    mav.signing.secret_key = key
    mav.signing.link_id = link_id
    mav.signing.timestamp = signing_timestamp()
    mav.signing.sign_outgoing = True
    mav.signing.allow_unsigned_callback = None
