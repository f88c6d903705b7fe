"""One MAVLink link: one endpoint, one owner thread, bounded queues, reconnection, counters.

The owner thread alone uses transport, parser and packers, and calls the handler. `send` may be
called from any thread.
"""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import SigningConfig
from mavlink_bridge.errors import BridgeStateError
from mavlink_bridge.link import signing
from mavlink_bridge.link.clock import monotonic_ns, utc_us
from mavlink_bridge.link.framing import FrameReader
from mavlink_bridge.link.signing import ReplayWindow
from mavlink_bridge.link.tlog import TlogRecorder
from mavlink_bridge.link.transport import Endpoint, Transport, UdpTransport, open_transport
from mavlink_bridge.link.waking import WakePipe

_log = logging.getLogger(__name__)

_OUTBOX = 512
_MAX_UNSENT = 4096  # bytes; more would wait so long on a slow port that it is worthless
_CONGESTED = _MAX_UNSENT // 8
_IDLE_TICK_S = 0.2
_BACKOFF_S = (0.1, 5.0)
_LONGEST_WAIT_S = 0.5
_MAX_READS = 64


class LinkHandler(Protocol):
    """Callbacks of a link, called in its owner thread. Errors are counted and logged."""

    def on_open(self, link: Link) -> None:
        """The transport was opened or reopened."""

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """A message arrived; its bytes were read at time_ns, CLOCK_MONOTONIC."""

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Do what is due; return when to be called next (CLOCK_MONOTONIC ns).

        Called also while the transport is closed; messages sent then are dropped and counted.
        """


@dataclass
class LinkCounters:
    """Counters of one link."""

    opened: int = 0
    open_failures: int = 0
    rx_bytes: int = 0
    tx_bytes: int = 0
    tx_messages: int = 0
    tx_dropped: int = 0
    handler_errors: int = 0
    failures: int = 0
    timeouts: int = 0


@dataclass(frozen=True)
class LinkOptions:
    """Settings of a link besides its endpoint. name: of thread and counters. wanted: ids of
    messages to decode, None: all. opener: opens the transport. recorder: records all frames.

    signing: None without; its key is read when the link is made (`SigningKeyError`). remembers: the
    newest timestamps of signed messages survive a restart, in a file. timeout_s: silence after
    which a stream (TCP, serial) is reopened.

    sender: of UDP, the only host that is accepted. follow_hosts_after_s: of UDP, silence after
    which another host is accepted. stop: ends the owner thread when it is set.
    """

    name: str = "link"
    wanted: Collection[int] | None = None
    signing: SigningConfig | None = None
    recorder: TlogRecorder | None = None
    timeout_s: float = 5.0
    opener: Callable[[Endpoint], Transport] = open_transport
    stop: threading.Event | None = None
    sender: tuple[str, int | None] | None = None
    follow_hosts_after_s: float | None = None
    remembers: bool = False


class Link:
    """A MAVLink 2 link that reconnects by itself. system_id: as which it sends; 0: nothing is sent.

    Above 200 lines: one thread owns transport, parser, packers and send queue. The order in which
    its loop serves them gives positions priority on a slow port.
    """

    def __init__(
        self, endpoint: Endpoint, handler: LinkHandler, options: LinkOptions | None = None
    ) -> None:
        o = options or LinkOptions()
        self.endpoint = endpoint
        self.name = o.name
        self.counters = LinkCounters()
        self.system_id = 0
        self._handler = handler
        self._options = o
        self._key: bytes | None = None
        self._window: ReplayWindow | None = None
        if o.signing is not None:
            self._key = signing.load_key(o.signing.key_file)
            if o.remembers:
                self._window = ReplayWindow(o.signing.state_path(o.name))
        self._reader = FrameReader(o.wanted, self._key, self._window)
        self._recorder = o.recorder
        self._packers: dict[int, Any] = {}
        self._outbox: deque[tuple[Any, int]] = deque(maxlen=_OUTBOX)
        self._unsent = bytearray()
        self._broken: OSError | None = None
        self._stop = threading.Event() if o.stop is None else o.stop
        self._thread: threading.Thread | None = None
        self._transport: Transport | None = None
        self._turn_ns: int | None = None
        self._waker = WakePipe()
        self._wake_read = self._waker.read_end

    @property
    def connected(self) -> bool:
        """Whether the transport is open (UDP: always, once bound)."""
        return self._transport is not None

    @property
    def port(self) -> int | None:
        """The local UDP port; None while the transport is closed, and for streams."""
        transport = self._transport
        return transport.port if isinstance(transport, UdpTransport) else None

    @property
    def last_tick_ns(self) -> int:
        """Start of the owner thread's newest cycle, CLOCK_MONOTONIC; now while it opens."""
        last_tick_ns = self._turn_ns
        return monotonic_ns() if last_tick_ns is None else last_tick_ns

    @property
    def congested(self) -> bool:
        """Whether the send queue of a slow port is so long that only positions should be added.

        Only the owner thread may read it.
        """
        return len(self._unsent) > _CONGESTED

    @property
    def stranger(self) -> str:
        """UDP: newest sender whose datagrams are dropped because it is not the peer; or ""."""
        transport = self._transport
        return transport.stranger if isinstance(transport, UdpTransport) else ""

    def keep_peer(self) -> None:
        """UDP: accept and answer only the sender of the present message; called in `on_message`."""
        if isinstance(self._transport, UdpTransport):
            self._transport.keep_peer()

    def start(self) -> None:
        """Start the owner thread, which connects. `BridgeStateError` after a first start."""
        if self._thread is not None:
            raise BridgeStateError(f"{self.name}: already started; make a new link")
        self._thread = threading.Thread(target=self._run, name=f"mavlink-{self.name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the owner thread, wait for it (5 s at most), and close the transport and the
        file of timestamps. Harmless when called again.
        """
        self._stop.set()
        self.wake()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=5.0)
        if self._window is not None:
            self._window.close()
        if self._thread is None or not self._thread.is_alive():
            self._waker.close()

    def wake(self) -> None:
        """Make the owner thread run `on_tick` now; returns at once. From any thread."""
        self._waker.wake()

    def send(self, message: Any, component: int) -> bool:
        """Send as `component` of `system_id`. In the owner thread: at once; False if dropped,
        because the transport is closed or full, or system_id is 0. From other threads: queue it and
        return True; of 512 queued messages the oldest is dropped.
        """
        if threading.current_thread() is self._thread:
            return self._send_now(message, component)
        if len(self._outbox) == _OUTBOX:
            self.counters.tx_dropped += 1
        self._outbox.append((message, component))
        self.wake()
        return True

    def stats(self) -> dict[str, int]:
        """Counters of the link and of its framing since the start, by name. `rx_of_strangers`:
        datagrams of other senders.
        """
        transport = self._transport
        refused = transport.refused if isinstance(transport, UdpTransport) else 0
        mine = {**asdict(self.counters), "rx_of_strangers": refused}
        return {**mine, **asdict(self._reader.counters)}

    # --- owner thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        backoff_s = _BACKOFF_S[0]
        while not self._stop.is_set():
            opened_ns = monotonic_ns()
            self._turn_ns = None  # a name server or a modem may take long
            self._transport = self._try_open()
            if self._transport is not None:
                self._serve_until_lost(self._transport)
            # An endpoint that accepts and closes at once must be backed off from, too.
            lasted = self._transport is not None and monotonic_ns() - opened_ns > 2e9
            self._transport = None
            backoff_s = _BACKOFF_S[0] if lasted else backoff_s
            self._idle(backoff_s)
            backoff_s = min(2.0 * backoff_s, _BACKOFF_S[1])

    def _try_open(self) -> Transport | None:
        try:
            return self._with_peer(self._options.opener(self.endpoint))
        except Exception as error:  # not OSError alone: a name or baud rate that a driver refuses
            self.counters.open_failures += 1
            if self.counters.open_failures == 1:
                _log.warning(
                    "%s: %s cannot be opened (%s), retrying", self.name, self.endpoint, error
                )
        return None

    def _with_peer(self, transport: Transport) -> Transport:
        o = self._options
        if isinstance(transport, UdpTransport):
            if o.sender is not None:
                transport.accept_only(*o.sender)
            if o.follow_hosts_after_s is not None:
                transport.follow_hosts_after(o.follow_hosts_after_s)
        return transport

    def _serve_until_lost(self, transport: Transport) -> None:
        self.counters.opened += 1
        try:
            self._serve(transport)
        except OSError as error:
            _log.warning("%s: %s lost (%s), reconnecting", self.name, self.endpoint, error)
        except Exception:  # whatever it is, the link must come back
            self.counters.failures += 1
            _log.exception("%s: %s failed, reconnecting", self.name, self.endpoint)
        finally:
            transport.close()

    def _idle(self, seconds: float) -> None:
        """Wait without a transport; `on_tick` is still called."""
        end_ns = monotonic_ns() + int(seconds * 1e9)
        while (left_ns := end_ns - monotonic_ns()) > 0:
            if self._stop.wait(min(left_ns * 1e-9, _IDLE_TICK_S)):
                return
            self._turn_ns = monotonic_ns()
            self._empty_outbox()
            self._guard(self._handler.on_tick, self, self._turn_ns)

    def _serve(self, transport: Transport) -> None:
        self._reader.reset()
        self._unsent.clear()
        self._broken = None
        self._guard(self._handler.on_open, self)
        # poll, not select: a process of many files has descriptors that select refuses.
        poller = select.poll()
        poller.register(self._wake_read, select.POLLIN)
        poller.register(transport, select.POLLIN)
        last_rx_ns = monotonic_ns()
        deadline_ns = 0
        while not self._stop.is_set():
            wait_s = min(max(deadline_ns - monotonic_ns(), 0) * 1e-9, _LONGEST_WAIT_S)
            poller.modify(transport, select.POLLIN | (select.POLLOUT if self._unsent else 0))
            ready = dict(poller.poll(wait_s * 1e3))
            self._turn_ns = monotonic_ns()
            events = ready.get(transport.fileno(), 0)
            if events & ~select.POLLOUT and self._receive(transport):
                last_rx_ns = monotonic_ns()
            if events & select.POLLOUT:
                self._flush()
            self._empty_outbox()
            now_ns = monotonic_ns()
            due = self._guard(self._handler.on_tick, self, now_ns)
            if self._broken is not None:
                raise self._broken
            deadline_ns = due if due is not None else now_ns + int(_LONGEST_WAIT_S * 1e9)
            if self._wake_read in ready:
                # Only now: a read may have to wait for the interpreter lock, and what woke us
                # should be on its way first. What came meanwhile has its turn at once.
                os.read(self._wake_read, 4096)
                deadline_ns = 0
            timeout_s = self._options.timeout_s
            if transport.stream and now_ns - last_rx_ns > timeout_s * 1e9:
                self.counters.timeouts += 1
                raise TimeoutError(f"nothing received for {timeout_s:.1f} s")

    def _empty_outbox(self) -> None:
        while self._outbox:
            self._send_now(*self._outbox.popleft())

    def _receive(self, transport: Transport) -> bool:
        """Read and dispatch what has arrived, a bounded amount; True if there was something."""
        received = False
        for _ in range(_MAX_READS):
            data = transport.read()
            if not data:
                break
            received = True
            time_ns = monotonic_ns()
            self.counters.rx_bytes += len(data)
            raw: deque[bytes] | None = deque() if self._recorder is not None else None
            messages = self._reader.feed(data, raw)
            if self._recorder is not None and raw:
                stamp = utc_us()
                for frame in raw:
                    self._recorder.write(frame, stamp)
            for message in messages:
                self._guard(self._handler.on_message, self, message, time_ns)
            if transport.stream:
                break  # select tells whether there is more
        return received

    def _guard(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a handler; its error is logged and counted, and the link continues."""
        try:
            return function(*arguments)
        except Exception:
            self.counters.handler_errors += 1
            if self.counters.handler_errors in (1, 10, 100, 1000):
                _log.exception(
                    "%s: handler failed (%d times)", self.name, self.counters.handler_errors
                )
            return None

    def _packer(self, component: int) -> Any:
        packer = self._packers.get(component)
        if packer is None:
            packer = mavlink.MAVLink(None, self.system_id, component)
            if self._key is not None and self._options.signing is not None:
                signing.enable(packer, self._key, self._options.signing.link_id)
            self._packers[component] = packer
        packer.srcSystem = self.system_id
        return packer

    def _send_now(self, message: Any, component: int) -> bool:
        if self._transport is None or self.system_id == 0:
            self.counters.tx_dropped += 1
            return False
        if len(self._unsent) > _MAX_UNSENT:
            self.counters.tx_dropped += 1
            return False
        packer = self._packer(component)
        if self._key is not None:
            # Never behind the wall clock or the peer: either refuses streams a minute old.
            packer.signing.timestamp = max(
                packer.signing.timestamp,
                signing.signing_timestamp(),
                self._reader.signing_timestamp,
            )
        frame = message.pack(packer)
        packer.seq = (packer.seq + 1) % 256
        return self._write(frame)

    def _write(self, frame: bytes) -> bool:
        assert self._transport is not None
        if self._transport.stream:
            self._unsent += frame
            self._flush()
        elif self._put(frame) == 0:
            self.counters.tx_dropped += 1
            return False
        self.counters.tx_messages += 1
        self.counters.tx_bytes += len(frame)
        if self._recorder is not None:
            self._recorder.write(frame, utc_us())
        return True

    def _flush(self) -> None:
        """Send the bytes of a stream that the transport did not take before."""
        if self._unsent:
            del self._unsent[: self._put(bytes(self._unsent))]

    def _put(self, data: bytes) -> int:
        """Write to the transport; its error is raised later, in the loop of the link."""
        assert self._transport is not None
        try:
            return self._transport.write(data)
        except OSError as error:
            self._broken = error
            return 0


def sleep_until(predicate: Callable[[], bool], timeout_s: float, step_s: float = 0.01) -> bool:
    """Poll until the predicate holds; False after the timeout."""
    end = time.monotonic() + timeout_s
    while not predicate():
        if time.monotonic() > end:
            return False
        time.sleep(step_s)
    return True
