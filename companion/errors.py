"""Named errors of the companion: each says what is wrong, where, and what to do."""

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


class CompanionError(Exception):
    """Base of every error that the companion raises on purpose."""


class StreamError(CompanionError):
    """Base of everything that can be wrong with a camera feed."""

    def with_text(self, text: str) -> StreamError:
        """The same error with another text."""
        return type(self)(text)


class StreamOpenError(StreamError):
    """A source that does not exist, cannot be opened, or is of an unknown kind."""


class StreamSizeError(StreamError):
    """Frames of another size than the camera model. size: of the frames, pixels."""

    def __init__(self, text: str, size: tuple[int, int] | None = None) -> None:
        super().__init__(text)
        self.size = size

    def with_text(self, text: str) -> StreamSizeError:
        """The same error with another text."""
        return StreamSizeError(text, self.size)


class StreamDepthError(StreamError):
    """A stream of 16-bit grey without `grey_range`, or of pixels that cannot be converted."""


class StreamDecodeError(StreamError):
    """An image or a video that is there but cannot be decoded."""


class ConfigError(CompanionError):
    """A configuration that cannot be read or is not valid; the text names file and key."""


class ReportError(CompanionError):
    """A report or record that cannot be written where the user asked for it."""


class DiskFaultError(ReportError):
    """A record that cannot be written because the disk is full or failing."""


class RecordError(CompanionError):
    """A flight's record that is not one, or that lacks what a replay needs."""


class FootageError(CompanionError):
    """Recorded footage that cannot be read, or that lacks what its localization needs."""


class DetectionError(CompanionError):
    """A datagram that is not a pixel detection."""


class DetectorError(CompanionError):
    """A detection network that cannot be loaded, or whose output is of no known layout."""


class MissionFileError(CompanionError):
    """A mission that cannot be read, or that is not on the map."""
