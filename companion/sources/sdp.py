"""Reads a session description (SDP, RFC 8866) of an RTP video feed: address and parameter sets.

QGroundControl, GStreamer and FFmpeg (``-sdp_file``) write such files for receivers.
"""

from __future__ import annotations

import base64
import binascii
import ipaddress
import re
from dataclasses import dataclass
from pathlib import Path

from companion.errors import StreamOpenError
from localizer.plain_files import plain_text

_CODECS = ("H264", "H265")
_SETS = re.compile(r"sprop-(?:parameter-sets|vps|sps|pps)=([^;\s]+)")
_START = b"\x00\x00\x00\x01"
_MOST_BYTES = 1 << 16


@dataclass(frozen=True)
class SdpSession:
    """host: to listen at: a multicast group, loopback or 0.0.0.0. sets: parameter sets (Annex B) or
    b"".
    """

    host: str
    port: int
    sets: bytes

    @classmethod
    def read(cls, path: Path) -> SdpSession:
        """Read a file; `StreamOpenError` if it describes no RTP video of H.264 or H.265."""
        try:
            text = plain_text(path, _MOST_BYTES)
        except (OSError, UnicodeDecodeError) as error:
            raise StreamOpenError(f"{path}: cannot be read: {error}") from error
        media = re.search(r"^m=video (\d+)\S* RTP/\w+ (\d+)", text, re.MULTILINE)
        if media is None or not 0 < int(media[1]) < 1 << 16:
            raise StreamOpenError(f"{path}: no line m=video PORT RTP/AVP TYPE; give the feed's SDP")
        kind = re.search(rf"^a=rtpmap:{media[2]} ([\w-]+)", text, re.MULTILINE)
        codec = kind[1].upper() if kind else f"payload type {media[2]}"
        if codec not in _CODECS:
            raise StreamOpenError(f"{path}: its video is {codec}; have it send H264 or H265")
        try:
            sets = [base64.b64decode(x, validate=True) for m in _SETS.findall(text)
                    for x in m.split(",") if x]  # fmt: skip
        except binascii.Error as error:
            raise StreamOpenError(f"{path}: damaged parameter sets: {error}") from error
        return cls(_host(text), int(media[1]), b"".join(_START + x for x in sets))


def _host(text: str) -> str:
    """The multicast group or loopback address, else 0.0.0.0: another may be the sender's."""
    line = re.search(r"^c=IN IP[46] ([^\s/]+)", text, re.MULTILINE)
    try:
        address = ipaddress.ip_address(line[1] if line else "0.0.0.0")
    except ValueError:
        return "0.0.0.0"
    return str(address) if address.is_multicast or address.is_loopback else "0.0.0.0"
