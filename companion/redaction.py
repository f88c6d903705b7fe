"""Credentials out of texts: a camera's address may hold a user's name and password."""

from __future__ import annotations

import re

HIDDEN = "***"
_IN_ADDRESS = re.compile(r"(?<=://)[^\s'\"]+(?=@)")
_IN_QUERY = re.compile(r"(?i)\b((?:pass(?:word|wd)?|pwd|user(?:name)?|token|key)=)[^&\s'\"]+")


def redacted(text: str) -> str:
    """The text with ``***`` for what stands before the @ of an address, and for passwords and
    tokens in its query.
    """
    return _IN_QUERY.sub(rf"\g<1>{HIDDEN}", _IN_ADDRESS.sub(HIDDEN, text))
