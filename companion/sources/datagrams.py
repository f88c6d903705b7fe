"""UDP socket of a video feed: one interface, one sender, read by FFmpeg as a file.

FFmpeg's own ``udp://`` binds every interface and mixes the packets of all senders to the port.
"""

from __future__ import annotations

import ipaddress
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from companion.errors import StreamOpenError
from companion.sources.rtp import (
    FORMATS,
    Kind,
    RtpDepacketizer,
    describe_unsupported,
    rtp_payload,
    video_format,
)
from mavlink_bridge.link.waking import WakePipe

_LARGEST = 65_535
_PER_READ = 64  # datagrams; then the decoder has its turn
_RECEIVE_BUFFER = 2_000_000
_UNPROVEN_NS = 6_000_000_000  # a camera gives its first picture within its key frame interval

Address = tuple[str, int]


class SilentSenderError(Exception):
    """The sender sent nothing for patience_s (s). instead: text on what other senders sent."""

    def __init__(self, patience_s: float, instead: str) -> None:
        super().__init__(instead or f"no data for {patience_s:g} s")
        self.instead = instead


@dataclass(frozen=True)
class UdpAddress:
    """Parsed ``udp://HOST:PORT?localaddr=ADDRESS``.

    host: address of this computer to listen at, or a multicast group. interface: address of the
    interface that joins the group; "": the system's choice.
    """

    host: str
    port: int
    interface: str = ""

    @classmethod
    def parse(cls, location: str) -> UdpAddress:
        """Parse a location; `StreamOpenError` without a port, or with an unknown option."""
        try:
            parts = urlsplit(location)
            port = parts.port
        except ValueError:
            port = None
        if not port:
            raise StreamOpenError(f"{location}: expected udp://HOST:PORT with a port of 1 to 65535")
        options = parse_qs(parts.query, keep_blank_values=True)
        if set(options) - {"localaddr"}:
            unknown = ", ".join(sorted(set(options) - {"localaddr"}))
            raise StreamOpenError(
                f"{location}: {unknown} cannot be set here; only localaddr (the interface of a "
                "multicast group), and camera.settings.sender says whose video is taken"
            )
        return cls(parts.hostname or "0.0.0.0", port, options.get("localaddr", [""])[0])

    def open_socket(self) -> socket.socket:
        """Open a non-blocking socket bound to it, in its multicast group; may raise OSError."""
        family, kind, _, _, where = socket.getaddrinfo(
            self.host, self.port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
        )[0]
        made = socket.socket(family, kind)
        try:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            made.setblocking(False)
            if ipaddress.ip_address(where[0]).is_multicast:
                made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                self._join(made, str(where[0]))
            made.bind(where)
        except BaseException:
            made.close()
            raise
        return made

    def _join(self, made: socket.socket, group: str) -> None:
        if made.family is socket.AF_INET6:
            index = socket.if_nametoindex(self.interface) if self.interface else 0
            request = socket.inet_pton(socket.AF_INET6, group) + struct.pack("@I", index)
            made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, request)
            return
        member = socket.inet_aton(group) + socket.inet_aton(self.interface or "0.0.0.0")
        made.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)


class SenderLock:
    """Accepts the datagrams of one sender: the configured one or the first one.

    Once a frame of the sender was decoded (`confirm_sender`), its address stays locked. The sender
    may change its port after `quiet_ns` of silence, as a camera does that restarts. If no frame of
    the first sender is decoded within 6 s, another sender may replace it, so that a stray packet
    does not lock the camera out.

    only: HOST or HOST:PORT, a numeric address; None: the first sender of video.
    """

    def __init__(self, only: str | None, quiet_ns: int) -> None:
        self._only = None if only is None else parse_sender(only)
        self._quiet_ns = quiet_ns
        self._sender: Address | None = None
        self._proven = False
        self._since_ns = self._heard_ns = 0

    @property
    def has_chosen(self) -> bool:
        """Whether a sender is accepted or configured: datagrams of others count as foreign."""
        return self._sender is not None or self._only is not None

    def confirm_sender(self) -> None:
        """A frame of the accepted sender was decoded: no other address replaces it any more."""
        self._proven = True

    def accepts(self, sender: Address, data: bytes, now_ns: int) -> bool:
        """Whether to use a datagram of now; one with video may make its sender the accepted."""
        if sender == self._sender or self._becomes_sender(sender, data, now_ns):
            self._heard_ns = now_ns
            return True
        return False

    def _becomes_sender(self, sender: Address, data: bytes, now_ns: int) -> bool:
        if self._only is not None and not _is(sender, self._only):
            return False
        if self._sender is not None and not self._may_be_replaced_by(sender, now_ns):
            return False
        if video_format(data) is None:
            return False
        if self._sender is None or sender[0] != self._sender[0]:
            self._proven = False
        self._sender, self._since_ns = sender, now_ns
        return True

    def _may_be_replaced_by(self, other: Address, now_ns: int) -> bool:
        assert self._sender is not None
        if other[0] == self._sender[0] and now_ns - self._heard_ns >= self._quiet_ns:
            return True
        return not self._proven and now_ns - self._since_ns >= _UNPROVEN_NS


class VideoDatagrams:
    """Receives the feed's UDP datagrams and gives FFmpeg the video in them, as a file (`read`).

    The socket stays bound from the first `begin` to `release`, so the accepted sender stays, too.
    The decoding thread reads; any thread may call `close`. The datagrams hold MPEG-TS, RTP (whose
    frames are assembled here), or raw H.264 or H.265.

    on_stranger: called in the reading thread, once for the address of each refused sender, for at
    most 16. sets: parameter sets of a session description, for an RTP stream that has none itself.
    """

    def __init__(
        self,
        address: UdpAddress,
        lock: SenderLock,
        on_stranger: Callable[[str], None] = lambda _: None,
        sets: bytes = b"",
    ) -> None:
        self._sets = sets
        self.patience_s = 1.0
        self.foreign = 0
        self._address = address
        self._lock = lock
        self._on_stranger = on_stranger
        self._told: set[str] = set()
        self._socket: socket.socket | None = None
        self._pending = b""
        self._kind: Kind | None = None
        self._depacketizer: RtpDepacketizer | None = None
        self._unread: tuple[str, bytes] | None = None  # newest sender and datagram, not taken
        self._silent = False
        self._closed = threading.Event()
        self._waker = WakePipe()

    def begin(self, patience_s: float) -> None:
        """Bind the socket if necessary, and drop waiting datagrams; called before each connection.

        patience_s: longest wait of `format` and `read`, s. Raises OSError while the address cannot
        be bound.
        """
        self.patience_s = patience_s
        self._pending, self._silent, self._unread = b"", False, None
        self._kind = self._depacketizer = None
        if self._socket is None:
            self._socket = self._address.open_socket()
        for _ in range(100 * _PER_READ):  # bounded: a flood would be drained for ever
            if self._received() is None:
                return

    def format(self) -> str:
        """Wait for video, after `begin`; FFmpeg's name of it. `SilentSenderError` as of `read`."""
        self._pending = self._next()
        return FORMATS[self._kind or "mpegts"]  # None: closed

    def confirm_sender(self) -> None:
        """A frame was decoded: the sender stays accepted."""
        self._lock.confirm_sender()

    def read(self, size: int) -> bytes:
        """Wait for data of the accepted sender; returns at most `size` bytes.

        b"" after `close`. Raises `SilentSenderError` if nothing was received within `patience_s`;
        from then on `read` returns b"" until `begin`, because the demuxer reads again after the
        error, and a second error would hide the first.
        """
        if self._silent:
            return b""
        if not self._pending:
            self._pending = self._next()
        given, self._pending = self._pending[:size], self._pending[size:]
        return given

    def close(self) -> None:
        """End a waiting `read`; any thread. The reading thread frees the socket by `release`."""
        self._closed.set()
        self._waker.wake()

    def release(self) -> None:
        """Free the socket; the reading thread calls it after the last read."""
        self._waker.close()
        if self._socket is not None:
            self._socket.close()

    def _next(self) -> bytes:
        assert self._socket is not None
        poller = select.poll()  # not select: a process of many files has too high descriptors
        poller.register(self._socket, select.POLLIN)
        poller.register(self._waker.read_end, select.POLLIN)
        deadline = time.monotonic() + self.patience_s
        while not self._closed.is_set():
            data = self._read_waiting()
            if data:
                return data
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                self._silent = True
                raise SilentSenderError(self.patience_s, self._describe_unread())
            poller.poll(left_s * 1e3)
        return b""

    def _read_waiting(self) -> bytes:
        """Video of the datagrams that wait and are accepted, in order, for FFmpeg."""
        taken = []
        for _ in range(_PER_READ):
            received = self._received()
            if received is None:
                break
            data, sender = received
            if not self._lock.accepts(sender, data, time.monotonic_ns()):
                self._unread = sender[0], data
                self._refuse(sender)
            elif self._kind is None and not self._set_format(data):
                self._unread = sender[0], data
            else:
                taken.append(self._read(data))
        return b"".join(taken)

    def _set_format(self, data: bytes) -> bool:
        """Set the feed's format by a datagram; False if it shows none."""
        self._kind = video_format(data)
        if self._kind in ("rtp h264", "rtp hevc"):
            self._depacketizer = RtpDepacketizer(
                "h264" if self._kind == "rtp h264" else "hevc", self._sets
            )
        return self._kind is not None

    def _read(self, data: bytes) -> bytes:
        """Bytes for FFmpeg from a datagram."""
        if self._depacketizer is not None:
            return self._depacketizer.add_packet(data)
        return rtp_payload(data) if self._kind == "rtp mpegts" else data

    def _describe_unread(self) -> str:
        """What arrives but is not used, for the operator; "" for nothing."""
        if self._depacketizer is not None and self._depacketizer.is_under_way:
            return "RTP comes, but no whole frame: packets are lost"
        if self._unread is None:
            return ""
        host, data = self._unread
        if video_format(data) is None:
            return f"from {host} come {describe_unsupported(data)}"
        return f"video comes from {host}, which is not the feed's sender (camera.settings.sender)"

    def _received(self) -> tuple[bytes, Address] | None:
        assert self._socket is not None
        try:
            data, sender = self._socket.recvfrom(_LARGEST)
        except (BlockingIOError, ConnectionRefusedError):
            return None
        return data, (sender[0], sender[1])

    def _refuse(self, sender: Address) -> None:
        self.foreign += 1
        host, _ = sender
        # 16: whoever forges addresses must not fill the record.
        if host in self._told or len(self._told) >= 16 or not self._lock.has_chosen:
            return
        self._told.add(host)
        self._on_stranger(host)


def parse_sender(text: str) -> tuple[str, int | None]:
    """Parse HOST or HOST:PORT ([HOST]:PORT for IPv6) to (host, port); port None: any. ValueError if
    the text is neither.
    """
    try:
        return str(ipaddress.ip_address(text)), None
    except ValueError:
        host, _, port = text.rpartition(":")
    try:
        address = str(ipaddress.ip_address(host.strip("[]")))
        number = int(port)
    except ValueError as error:
        raise ValueError(f"{text!r} is no sender; write ADDRESS or ADDRESS:PORT") from error
    if not 1 <= number <= 65535:
        raise ValueError(f"{text!r}: {number} is no port number")
    return address, number


def _is(sender: Address, wanted: tuple[str, int | None]) -> bool:
    host, port = wanted
    return sender[0] == host and port in (None, sender[1])
