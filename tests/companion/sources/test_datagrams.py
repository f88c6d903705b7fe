"""Whose video a UDP feed takes: one sender's, by a rule, and strangers are told once."""

from __future__ import annotations

import socket
from collections.abc import Iterator

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

S = 1_000_000_000
TS = (b"\x47" + bytes(187)) * 7
CAMERA, AGAIN, STRANGER = ("10.0.0.2", 4000), ("10.0.0.2", 4001), ("10.0.0.9", 4000)


def test_the_first_sender_of_video_is_followed_and_no_other() -> None:
    lock = SenderLock(None, S)
    assert lock.admits(CAMERA, TS, 0)
    lock.prove()
    assert not lock.admits(STRANGER, TS, 1)
    assert not lock.admits(STRANGER, TS, 10**6 * S), "not after any silence"
    assert lock.admits(CAMERA, TS, 10**6 * S)


def test_a_camera_that_restarts_may_speak_from_another_port_once_the_old_one_is_silent() -> None:
    lock = SenderLock(None, S)
    assert lock.admits(CAMERA, TS, 0)
    lock.prove()
    assert not lock.admits(AGAIN, TS, S // 2), "two at once on one host would be mixed"
    assert lock.admits(AGAIN, TS, S)
    assert not lock.admits(CAMERA, TS, S + 1)


def test_a_stray_packet_does_not_lock_the_camera_out() -> None:
    lock = SenderLock(None, S)
    assert not lock.admits(STRANGER, b"GET / HTTP/1.1", 0)
    assert lock.admits(STRANGER, TS, 0), "it looks like video but no picture comes of it"
    assert not lock.admits(CAMERA, TS, 2 * S)
    assert lock.admits(CAMERA, TS, 6 * S)
    lock.prove()
    assert not lock.admits(STRANGER, TS, 60 * S)


def test_video_is_recognised_where_a_datagram_begins_inside_a_packet() -> None:
    assert SenderLock(None, S).admits(CAMERA, TS[100:], 0)
    assert not SenderLock(None, S).admits(CAMERA, bytes(1316), 0)


@pytest.mark.parametrize(("only", "taken"), [("10.0.0.2", True), ("10.0.0.2:4000", False)])
def test_a_configured_sender_is_the_only_one(only: str, taken: bool) -> None:
    lock = SenderLock(only, S)
    assert not lock.admits(STRANGER, TS, 0)
    assert lock.admits(CAMERA, TS, 0)
    assert not lock.admits(STRANGER, TS, 60 * S)
    assert lock.admits(AGAIN, TS, 60 * S) is taken


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
    feed.prove()
    for _ in range(5):
        stranger.send(other)
        camera.send(own)
        assert feed.read(65536) == own
    assert feed.foreign == 5
    assert sockets.told == ["stranger's video ignored: 127.0.0.2"]
    assert len(f"PiLoT: {sockets.told[0]}".replace("127.0.0.2", "255.255.255.255")) <= 50


def test_the_sender_is_kept_over_a_reconnection_and_old_packets_are_not(sockets: Sockets) -> None:
    feed = sockets.feed
    feed.begin(30.0)
    camera, stranger = sockets.sender("127.0.0.1"), sockets.sender("127.0.0.2")
    camera.send(TS)
    assert feed.read(65536) == TS
    feed.prove()
    camera.send(b"old")
    stranger.send(TS)
    feed.begin(30.0)
    stranger.send(TS)
    camera.send(b"new")
    assert feed.read(65536) == b"new"


def test_a_read_returns_at_most_what_is_asked_and_loses_nothing(sockets: Sockets) -> None:
    sockets.feed.begin(30.0)
    sockets.sender("127.0.0.1").send(TS)
    assert sockets.feed.read(1000) + sockets.feed.read(1000) == TS


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
        address.bound() as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        sender.sendto(TS, ("239.255.42.42", receiver.getsockname()[1]))
        receiver.settimeout(30.0)
        assert receiver.recv(2000) == TS
