"""Whose video a UDP feed takes: one sender's, by a rule, and strangers are told once."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.errors import StreamOpenError
from companion.sources import SourceSettings
from companion.sources.datagrams import (
    SenderLock,
    SilentSenderError,
    UdpAddress,
    VideoDatagrams,
    parse_sender,
)
from companion.sources.rtp import RtpDepacketizer, SdpSession, video_format

S = 1_000_000_000
TS = (b"\x47" + bytes(187)) * 7
CAMERA, AGAIN, STRANGER = ("10.0.0.2", 4000), ("10.0.0.2", 4001), ("10.0.0.9", 4000)


@pytest.mark.parametrize(
    ("only", "script"),
    [
        # The first sender of video is followed and no other, after whatever silence.
        (None, [(CAMERA, 0, True), ("picture",), (STRANGER, 1e-9, False), (STRANGER, 1e6, False),
                (CAMERA, 1e6, True)]),
        # A camera that restarts may speak from another port, once the old one is silent: two at
        # once on one host would be mixed.
        (None, [(CAMERA, 0, True), ("picture",), (AGAIN, 0.5, False), (AGAIN, 1, True),
                (CAMERA, 1.1, False)]),
        # A stray packet that looks like video does not lock the camera out.
        (None, [(STRANGER, 0, True), (CAMERA, 2, False), (CAMERA, 6, True), ("picture",),
                (STRANGER, 60, False)]),
        # A configured sender is the only one.
        ("10.0.0.2", [(STRANGER, 0, False), (CAMERA, 0, True), (STRANGER, 60, False),
                      (AGAIN, 60, True)]),
        ("10.0.0.2:4000", [(STRANGER, 0, False), (CAMERA, 0, True), (STRANGER, 60, False),
                           (AGAIN, 60, False)]),
    ],
)  # fmt: skip
def test_one_sender_is_followed(only, script):
    lock = SenderLock(only, S)
    assert not lock.accepts(CAMERA, b"GET / HTTP/1.1", 0)  # no video
    for sender, *rest in script:
        if sender == "picture":
            lock.confirm_sender()
        else:
            at_s, taken = rest
            assert lock.accepts(sender, TS, round(at_s * S)) is taken, (sender, at_s)


def test_video_is_recognised_where_a_datagram_begins_inside_a_packet() -> None:
    assert SenderLock(None, S).accepts(CAMERA, TS[100:], 0)
    assert not SenderLock(None, S).accepts(CAMERA, bytes(1316), 0)


@pytest.mark.parametrize("text", ["camera", "10.0.0.2:0", "10.0.0.2:x", "10.0.0:1", ""])
def test_what_is_no_sender_is_named(text: str) -> None:
    with pytest.raises(ValueError, match=r"ADDRESS|port"):
        SourceSettings(sender=text)


def test_senders_of_both_address_families_are_read() -> None:
    assert parse_sender("10.0.0.2:5600") == ("10.0.0.2", 5600)
    assert parse_sender("[fe80::2]:5600") == ("fe80::2", 5600)
    assert parse_sender("fe80::2") == ("fe80::2", None)


@pytest.mark.parametrize(
    ("location", "address"),
    [
        ("udp://127.0.0.1:5600", UdpAddress("127.0.0.1", 5600)),
        ("udp://:5600", UdpAddress("0.0.0.0", 5600)),
        ("udp://@239.1.1.1:5600?localaddr=10.0.0.1", UdpAddress("239.1.1.1", 5600, "10.0.0.1")),
    ],
)
def test_addresses_of_a_feed(location: str, address: UdpAddress) -> None:
    assert UdpAddress.parse(location) == address


def test_options_that_would_be_without_effect_are_named() -> None:
    with pytest.raises(StreamOpenError, match=r"sources cannot be set.*camera\.settings\.sender"):
        UdpAddress.parse("udp://127.0.0.1:5600?sources=10.0.0.2")


class Sockets:
    """A feed's socket, and senders to it, on this computer's loopback addresses."""

    def __init__(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.address = UdpAddress("127.0.0.1", free.getsockname()[1])
        self.told: list[str] = []
        self.feed = VideoDatagrams(self.address, SenderLock(None, S), self.told.append)
        self._senders: list[socket.socket] = []

    def sender(self, host: str) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind((host, 0))
        made.connect((self.address.host, self.address.port))
        self._senders.append(made)
        return made

    def close(self) -> None:
        self.feed.close()
        self.feed.release()
        for sender in self._senders:
            sender.close()


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    made = Sockets()
    yield made
    made.close()


def test_packets_of_a_second_sender_never_reach_the_decoder(sockets: Sockets) -> None:
    feed = sockets.feed
    feed.begin(30.0)
    camera, stranger = sockets.sender("127.0.0.1"), sockets.sender("127.0.0.2")
    own, other = TS, TS.replace(b"\0", b"\1")
    camera.send(own)
    assert feed.read(65536) == own
    feed.confirm_sender()
    for _ in range(5):
        stranger.send(other)
        camera.send(own)
        assert feed.read(65536) == own
    assert feed.foreign == 5
    assert sockets.told == ["127.0.0.2"]


def test_the_sender_is_kept_over_a_reconnection_and_old_packets_are_not(sockets: Sockets) -> None:
    feed = sockets.feed
    feed.begin(30.0)
    camera, stranger = sockets.sender("127.0.0.1"), sockets.sender("127.0.0.2")
    camera.send(TS)
    assert feed.read(65536) == TS
    feed.confirm_sender()
    camera.send(TS[188:])
    stranger.send(TS)
    feed.begin(30.0)
    stranger.send(TS)
    camera.send(TS[376:])
    assert feed.read(65536) == TS[376:]


def test_silence_and_closing_end_a_read(sockets: Sockets) -> None:
    sockets.feed.begin(0.0)
    with pytest.raises(SilentSenderError):
        sockets.feed.read(10)
    sockets.sender("127.0.0.1").send(TS)
    assert sockets.feed.read(10) == b""  # a demuxer asks again: it is over
    sockets.feed.begin(30.0)
    sockets.feed.close()
    assert sockets.feed.read(10) == b""


def test_only_the_named_interface_is_bound(sockets: Sockets) -> None:
    sockets.feed.begin(30.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as elsewhere:
        elsewhere.bind(("127.0.0.3", sockets.address.port))  # fails where all are bound


def test_a_multicast_group_is_joined_on_the_interface() -> None:
    address = UdpAddress("239.255.42.42", 0, "127.0.0.1")
    with (
        address.open_socket() as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        sender.sendto(TS, ("239.255.42.42", receiver.getsockname()[1]))
        receiver.settimeout(30.0)
        assert receiver.recv(2000) == TS


# What FFmpeg, GStreamer and cameras send, by its first bytes.
RTP = bytes.fromhex("80600001 00015f90 12345678".replace(" ", ""))
KINDS = [
    (TS, "mpegts"),
    (RTP.replace(b"\x60", b"\x21") + TS, "rtp mpegts"),
    (RTP + bytes.fromhex("6742c01e"), "rtp h264"),  # parameters
    (RTP + bytes.fromhex("7800096742c01e"), "rtp h264"),  # several units
    (RTP + bytes.fromhex("7c85b800"), "rtp h264"),  # a part of a key frame
    (RTP + bytes.fromhex("5c01aabb"), "rtp h264"),  # from the middle of a picture
    (RTP + bytes.fromhex("40010c01"), "rtp hevc"),
    (RTP + bytes.fromhex("62019300"), "rtp hevc"),
    (bytes.fromhex("90e00001 00015f90 12345678 bede0001 00000000 6742c01e"), "rtp h264"),
    (bytes.fromhex("000000016742c01e"), "h264"),
    (bytes.fromhex("00000109f0"), "h264"),
    (bytes.fromhex("0000000140010c01"), "hevc"),
]


@pytest.mark.parametrize(("data", "kind"), KINDS)
def test_what_a_feed_is_of_is_seen_by_a_datagram(data: bytes, kind: str) -> None:
    assert video_format(data) == kind
    assert SenderLock(None, S).accepts(CAMERA, data, 0)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (bytes.fromhex("fd09000001010000000000000000000403"), "MAVLink"),
        (RTP.replace(b"\x60", b"\x1a") + bytes(40), "RTP of payload type 26, JPEG"),
        # A byte that is MPEG-TS's, by chance.
        (RTP.replace(b"\x60", b"\x1a") + bytes(88) + b"G" + bytes(99), "payload type 26, JPEG"),
        (b"GET / HTTP/1.1\r\n", "begin with 47 45 54 20"),
    ],
)
def test_what_comes_and_is_not_read_is_named(sockets: Sockets, data: bytes, told: str) -> None:
    """Never "nothing came" while something comes."""
    sockets.feed.begin(0.05)
    sockets.sender("127.0.0.1").send(data)
    with pytest.raises(SilentSenderError, match=f"from 127.0.0.1 come .*{told}"):
        sockets.feed.format()


def test_video_of_another_than_the_chosen_sender_is_named() -> None:
    made = Sockets()
    feed = VideoDatagrams(made.address, SenderLock("127.0.0.9", S))
    feed.begin(0.05)
    made.sender("127.0.0.1").send(TS)
    with pytest.raises(SilentSenderError, match=r"video comes from 127\.0\.0\.1, which is not"):
        feed.format()
    feed.release()
    made.close()


def rtp(sequence: int, time: int, payload: bytes, *, last: bool) -> bytes:
    return struct.pack(">BBHII", 0x80, 0x60 | last << 7, sequence & 0xFFFF, time, 7) + payload


def pictures(ivf: bytes) -> list[tuple[int, bytes]]:
    """(time, Annex B) of each, after IVF's header."""
    assert ivf[:12] == b"DKIF\0\0 \0H264"
    found, at = [], 32
    while at < len(ivf):
        size, time = struct.unpack_from("<Iq", ivf, at)
        found.append((time, ivf[at + 12 : at + 12 + size]))
        at += 12 + size
    return found


def test_rtp_packets_become_pictures_with_their_times() -> None:
    """Units alone, several in one packet, one in three; times that wrap; a packet that is lost."""
    made = RtpDepacketizer("h264")
    start, first = b"\0\0\0\1", (1 << 32) - 1500
    packets = [
        rtp(65534, first, b"\x78\0\2\x67\x42\0\3\x68\xce\x3c", last=False),
        rtp(65535, first, b"\x7c\x85AA", last=False),
        rtp(0, first, b"\x7c\x05BB", last=False),
        rtp(1, first, b"\x7c\x45CC", last=True),
        rtp(2, 1500, b"\x41dd", last=True),
        rtp(3, 4500, b"\x5c\x81EE", last=False),
        rtp(5, 4500, b"\x5c\x41FF", last=True),  # 4 is lost
        rtp(6, 7500, b"\x41gg", last=False),  # without a mark: the next picture's time ends it
        rtp(7, 10500, b"\x41hh", last=True),
    ]
    found = pictures(b"".join(map(made.add_packet, packets)))
    assert found == [
        (0, start + b"\x67\x42" + start + b"\x68\xce\x3c" + start + b"\x65AABBCC"),
        (3000, start + b"\x41dd"), (9000, start + b"\x41gg"), (12000, start + b"\x41hh"),
    ]  # fmt: skip


# --- Session descriptions: where an RTP feed comes, and what its decoder needs ------------------


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
