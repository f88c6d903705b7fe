"""Session descriptions: where an RTP feed comes, and what its decoder needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import StreamOpenError
from companion.sources.sdp import SdpSession

QGC = (
    "v=0\r\no=- 0 0 IN IP4 192.168.0.10\r\ns=feed\r\nc=IN IP4 192.168.0.10\r\nt=0 0\r\n"
    "m=video 5600 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\n"
    "a=fmtp:96 packetization-mode=1; sprop-parameter-sets=Z0LAHg==,aM48gA==; profile-level-id=42"
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "feed.sdp"


def test_address_and_parameter_sets_are_read(path: Path) -> None:
    path.write_text(QGC)
    sets = b"\0\0\0\1\x67\x42\xc0\x1e\0\0\0\1\x68\xce\x3c\x80"
    assert SdpSession.read(path) == SdpSession(
        "0.0.0.0", 5600, sets
    )  # another address: the sender's
    path.write_text(
        "\ufeff" + QGC.replace("c=IN IP4 192.168.0.10", "c=IN IP4 239.1.1.1/8"), "utf-8"
    )
    assert SdpSession.read(path).host == "239.1.1.1"
    path.write_text(QGC.replace("H264", "H265").replace("sprop-parameter-sets", "sprop-vps"))
    assert SdpSession.read(path).sets == sets


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("m=video 5600", "m=audio 5600"), "no line m=video"),
        (("H264", "JPEG"), "its video is JPEG; have it send H264"),
        (("Z0LAHg==", "Z0L!"), "damaged parameter sets"),
    ],
)
def test_another_session_is_named(path: Path, change: tuple[str, str], message: str) -> None:
    path.write_text(QGC.replace(*change))
    with pytest.raises(StreamOpenError, match=rf"feed\.sdp: .*{message}"):
        SdpSession.read(path)
    with pytest.raises(StreamOpenError, match="cannot be read"):
        SdpSession.read(path.with_name("missing.sdp"))
