"""Removes credentials from texts: a camera's URL may contain user name and password."""

from __future__ import annotations

import re

HIDDEN = "***"
_IN_ADDRESS = re.compile(r"(?<=://)[^\s'\"]+(?=@)")
_IN_QUERY = re.compile(r"(?i)\b((?:pass(?:word|wd)?|pwd|user(?:name)?|token|key)=)[^&\s'\"]+")


def redacted(text: str) -> str:
    """The text with ``***`` for the user part of URLs, and for passwords and tokens in their
    queries.
    """
    return _IN_QUERY.sub(rf"\g<1>{HIDDEN}", _IN_ADDRESS.sub(HIDDEN, text))
