"""Links by themselves: TCP that breaks, serial, limits, queues; streams that are asked for."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, VehicleState
from mavlink_bridge.config import CameraConfig, SigningConfig
from mavlink_bridge.errors import BridgeStateError, EndpointError
from mavlink_bridge.link.framing import FrameReader
from mavlink_bridge.link.link import Link, LinkOptions, sleep_until
from mavlink_bridge.link.signing import create_key
from mavlink_bridge.link.transport import Endpoint, UdpTransport, open_transport
from mavlink_bridge.link.waking import WakePipe
from mavlink_bridge.vehicle.streams import StreamKeeper, wanted_streams
from tests.mavlink_bridge.simulated import lengths

SECOND = 1_000_000_000
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3)


def packed(system: int = 1) -> bytes:
    return bytes(HEARTBEAT.pack(mavlink.MAVLink(None, system, 1)))


class Recorder:
    """A handler that remembers; `fail` makes it raise."""

    def __init__(self) -> None:
        self.opened = 0
        self.messages: list[Any] = []
        self.ticks = 0
        self.fail = False

    def on_open(self, link: Link) -> None:
        self.opened += 1

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        self.messages.append(message)
        if self.fail:
            raise RuntimeError("handler")

    def on_tick(self, link: Link, now_ns: int) -> int:
        self.ticks += 1
        return now_ns + SECOND // 10


@pytest.fixture
def start() -> Iterator[Callable[..., tuple[Link, Recorder]]]:
    links = []

    def make(endpoint: str, **options: Any) -> tuple[Link, Recorder]:
        handler = Recorder()
        link = Link(Endpoint.parse(endpoint), handler, LinkOptions(**options))
        link.system_id = 1
        links.append(link)
        link.start()
        return link, handler

    yield make
    for link in links:
        link.stop()


def bound(port: int = 0) -> socket.socket:
    """A TCP socket that refuses connections; whoever reuses addresses may listen beside it."""
    it = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    it.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    it.bind(("127.0.0.1", port))
    return it


def listen(port: int = 0) -> socket.socket:
    server = bound(port)
    server.listen(4)
    server.settimeout(30.0)
    return server


@pytest.mark.parametrize(
    ("text", "kind", "address", "number"),
    [
        ("udpin:0.0.0.0:14550", "udpin", "0.0.0.0", 14550),
        ("tcp:host.example:5762", "tcp", "host.example", 5762),
        ("serial:/dev/ttyTHS1:921600", "serial", "/dev/ttyTHS1", 921600),
        ("udpout:10.0.0.1:14550", "udpout", "10.0.0.1", 14550),
    ],
)
def test_endpoints(text: str, kind: str, address: str, number: int) -> None:
    endpoint = Endpoint.parse(text)
    assert (endpoint.kind, endpoint.address, endpoint.number) == (kind, address, number)
    assert str(endpoint) == text


@pytest.mark.parametrize(
    "text",
    ["", "tcp", "tcp:host", "ftp:host:1", "tcp:host:port", "tcp::1", "udpin: 0.0.0.0:14550",
     "tcp:[::1]:5760", "udpin:::1:14550", "udpout://10.0.0.1:14550"],
)  # fmt: skip
def test_wrong_endpoints_say_what_is_wanted(text: str) -> None:
    with pytest.raises(EndpointError, match="udpin:HOST:PORT"):
        Endpoint.parse(text)
    with pytest.raises(ValidationError, match="is no endpoint"):
        BridgeConfig(connection=text)
    with pytest.raises(EndpointError, match="70000 is no port"):
        Endpoint.parse("tcp:host:70000")


class Speakers:
    """A listening transport on a clock of its own, and sockets of two hosts that speak to it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, where: str = "udpin:127.0.0.1:0") -> None:
        self.now_s = 1000.0
        clock = SimpleNamespace(monotonic=lambda: self.now_s)
        monkeypatch.setattr("mavlink_bridge.link.transport.time", clock)
        opened = open_transport(Endpoint.parse(where))
        assert isinstance(opened, UdpTransport)
        self.ours = opened
        self.vehicle = self.speaker("127.0.0.1")
        self.again = self.speaker("127.0.0.1")
        self.stranger = self.speaker("127.0.0.2")

    def speaker(self, host: str) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind((host, 0))
        made.settimeout(30.0)
        return made

    def is_heard(self, speaker: socket.socket) -> bool:
        """Whether a message of it is read; on loopback it is there when sendto returns."""
        speaker.sendto(packed(), ("127.0.0.1", self.ours.port))
        return bool(self.ours.read())

    def is_answered(self, speaker: socket.socket) -> bool:
        self.ours.write(b"position")
        speaker.setblocking(False)
        try:
            return speaker.recv(100) == b"position"
        except BlockingIOError:
            return False

    def close(self) -> None:
        for end in (self.ours, self.vehicle, self.again, self.stranger):
            end.close()


@pytest.fixture
def speakers(monkeypatch: pytest.MonkeyPatch) -> Iterator[Speakers]:
    made = Speakers(monkeypatch)
    yield made
    made.close()


def test_who_speaks_before_the_vehicle_is_heard_and_gives_way_to_it(speakers: Speakers) -> None:
    assert speakers.is_heard(speakers.stranger)
    assert speakers.is_answered(speakers.stranger)
    assert speakers.is_heard(speakers.vehicle)
    speakers.ours.keep_peer()
    assert speakers.is_answered(speakers.vehicle)


def test_once_a_peer_is_kept_nobody_else_is_heard_or_answered(speakers: Speakers) -> None:
    """A forged heartbeat of the vehicle's ids must not get the positions, after any silence."""
    ours = speakers.ours
    assert speakers.is_heard(speakers.vehicle)
    ours.keep_peer()
    for _ in range(3):
        assert not speakers.is_heard(speakers.stranger)
        assert not speakers.is_heard(speakers.again)
        assert speakers.is_heard(speakers.vehicle)
        ours.keep_peer()
        speakers.now_s += 2.0
    assert ours.refused == 6
    speakers.now_s += 3600.0
    assert not speakers.is_heard(speakers.stranger)
    assert ours.stranger == "127.0.0.2"
    assert speakers.is_answered(speakers.vehicle)


def test_a_vehicle_that_restarts_may_speak_from_another_port_of_its_host(speakers):
    assert speakers.is_heard(speakers.vehicle)
    speakers.ours.keep_peer()
    speakers.now_s += 3.0
    assert speakers.is_heard(speakers.again)
    speakers.ours.keep_peer()
    assert speakers.is_answered(speakers.again)
    assert not speakers.is_heard(speakers.vehicle)


def test_where_it_is_allowed_another_host_takes_over_after_silence(speakers: Speakers) -> None:
    speakers.ours.follow_hosts_after(10.0)
    assert speakers.is_heard(speakers.vehicle)
    speakers.ours.keep_peer()
    speakers.now_s += 9.0
    assert not speakers.is_heard(speakers.stranger)
    speakers.now_s += 1.0
    assert speakers.is_heard(speakers.stranger)


def test_a_configured_sender_is_heard_from_the_start_and_nobody_else(speakers: Speakers) -> None:
    speakers.ours.accept_only("127.0.0.1", None)
    assert not speakers.is_heard(speakers.stranger)
    assert speakers.is_heard(speakers.vehicle)


def test_a_link_that_sends_first_hears_only_whom_it_sends_to(monkeypatch, speakers):
    port = speakers.vehicle.getsockname()[1]
    ours = open_transport(Endpoint.parse(f"udpout:127.0.0.1:{port}"))
    assert isinstance(ours, UdpTransport)
    ours.write(b"hello")
    _, where = speakers.vehicle.recvfrom(100)
    for speaker, heard in ((speakers.stranger, b""), (speakers.vehicle, packed())):
        speaker.sendto(packed(), ("127.0.0.1", where[1]))
        assert ours.read() == heard
    ours.close()


def test_a_second_process_cannot_take_a_udp_port_over() -> None:
    """As `companion doctor` would in flight: the last socket bound gets the datagrams."""
    first = open_transport(Endpoint.parse("udpin:127.0.0.1:0"))
    assert isinstance(first, UdpTransport)
    with pytest.raises(OSError, match="in use"):
        open_transport(Endpoint.parse(f"udpin:127.0.0.1:{first.port}"))
    first.close()


NO_SENDERS = ("vehicle", "10.0.0.1:", "10.0.0.1:0", "10.0.0.1:70000", "::1")
ONE_PEER = ("tcp:127.0.0.1:5760", "udpout:127.0.0.1:14550")
WITHOUT_SET = ("global_position_sensor", "external_position_estimate")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        *(({"sender": text}, "sender|port") for text in NO_SENDERS),
        # It was ignored without a word, and looked like a guard.
        *(({"sender": "127.0.0.1", "connection": text}, "udpin") for text in ONE_PEER),
        *(({"injection": {"message": kind}, "switch": {"enabled": True}},
           f"{kind}.*no source set: remove switch.enabled") for kind in WITHOUT_SET),
        ({"injection": {"message": "gps_input", "rate_hz": 4.0}}, "rate_hz >= 5"),
        ({"targets": {"adsb": True}}, "needs ground_connection"),
        ({"targets": {"cot_aircraft": True}}, r"needs targets\.cot_endpoint"),
        # It would come back through the autopilot.
        ({"texts_as_autopilot": True}, "texts_as_autopilot needs ground_connection"),
        ({"conection": "tcp:localhost:1"}, "extra"),
    ],
)  # fmt: skip
def test_a_configuration_that_cannot_work_is_refused(options: dict[str, Any], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        BridgeConfig(**options)


def test_a_mode_off_of_yaml_is_no_boolean() -> None:
    assert BridgeConfig(mode=False).mode == "off"  # type: ignore[arg-type]


def test_tcp_is_reopened_when_the_server_goes_and_comes_back(start):
    """Half a frame before the break does not spoil the next one."""
    reserved = bound()  # nobody else gets its port meanwhile
    port = reserved.getsockname()[1]
    server = listen(port)
    link, handler = start(f"tcp:127.0.0.1:{port}")
    first, _ = server.accept()
    first.sendall(packed() + packed()[:7])
    assert sleep_until(lambda: lengths(link)["buffer"] == 7, 30.0)
    first.close()
    server.close()
    assert sleep_until(lambda: link.counters.open_failures > 0, 30.0)
    assert not link.connected
    server = listen(port)
    second, _ = server.accept()
    second.sendall(packed())
    assert sleep_until(lambda: len(handler.messages) == 2, 30.0)
    assert handler.opened == 2
    for end in (second, server, reserved):
        end.close()


def test_silent_tcp_is_reopened(start: Callable[..., tuple[Link, Recorder]]) -> None:
    with listen() as server:
        link, _ = start(f"tcp:127.0.0.1:{server.getsockname()[1]}", timeout_s=0.4)
        silent, _ = server.accept()
        again, _ = server.accept()
        assert link.counters.timeouts >= 1
        silent.close()
        again.close()


def test_peer_that_does_not_read_costs_messages_not_memory_or_time(start):
    with listen() as server:
        link, _ = start(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        deaf, _ = server.accept()
        text = mavlink.MAVLink_statustext_message(6, b"x" * 50)
        begun = time.monotonic()
        for _ in range(200):
            for _ in range(400):
                link.send(text, 191)
            time.sleep(0.002)
        assert time.monotonic() - begun < 60.0  # a send that blocked once would never end
        assert sleep_until(lambda: link.counters.tx_dropped > 1000, 30.0)
        assert lengths(link)["unsent"] < 128 * 1024
        deaf.close()


def test_tcp_server_takes_a_client(start: Callable[..., tuple[Link, Recorder]]) -> None:
    with bound() as reserved:
        port = reserved.getsockname()[1]
        link, handler = start(f"tcpin:127.0.0.1:{port}")
        client: socket.socket | None = None

        def connected() -> bool:
            """It listens for two seconds at a time; who comes between them comes again."""
            nonlocal client
            if client is None:
                with contextlib.suppress(ConnectionRefusedError):
                    client = socket.create_connection(("127.0.0.1", port), timeout=5.0)
            elif not sleep_until(lambda: link.connected, 3.0):
                client.close()
                client = None
            return client is not None and link.connected

        assert sleep_until(connected, 60.0, step_s=0.05)
        client.sendall(packed())
        assert sleep_until(lambda: len(handler.messages) == 1, 30.0)
        client.close()


def test_serial_port_both_ways_and_unplugged(start, tmp_path):
    master, slave = pty.openpty()
    tty.setraw(slave)
    device = tmp_path / "ttyUSB0"  # a terminal's number is soon another's
    device.symlink_to(os.ttyname(slave))
    link, handler = start(f"serial:{device}:115200")
    assert sleep_until(lambda: link.connected, 30.0)
    os.write(master, packed())
    assert sleep_until(lambda: len(handler.messages) == 1, 30.0)
    link.send(HEARTBEAT, 191)
    codec = mavlink.MAVLink(None)
    (message,) = codec.parse_buffer(os.read(master, 4096))
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)
    device.unlink()
    os.close(slave)
    os.close(master)
    assert sleep_until(lambda: link.counters.open_failures > 0, 30.0)


def test_whatever_opening_raises_it_is_tried_again() -> None:
    """A host name with an empty label is a UnicodeError, an odd baud rate a ValueError: the thread
    ended, and with it every position, untold.
    """
    refusals = iter([UnicodeError("label empty or too long"), ValueError("invalid baud rate")])

    def opener(endpoint: Endpoint) -> Any:
        error = next(refusals, None)
        if error is not None:
            raise error
        return open_transport(endpoint)

    link = Link(Endpoint.parse("udpin:127.0.0.1:0"), Recorder(), LinkOptions(opener=opener))
    link.start()
    try:
        assert sleep_until(lambda: link.connected, 30.0)
    finally:
        link.stop()
    assert link.counters.open_failures == 2


def test_failing_handler_is_counted_and_the_link_lives(start):
    with listen() as server:
        link, handler = start(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        client, _ = server.accept()
        handler.fail = True
        client.sendall(packed() * 3)
        assert sleep_until(lambda: link.counters.handler_errors == 3, 30.0)
        handler.fail = False
        client.sendall(packed())
        assert sleep_until(lambda: len(handler.messages) == 4, 30.0)
        client.close()


def test_nothing_is_sent_before_the_vehicles_id_is_known(start):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        link, _ = start(f"udpout:127.0.0.1:{peer.getsockname()[1]}")
        link.system_id = 0
        assert sleep_until(lambda: link.connected, 30.0)
        link.send(HEARTBEAT, 191)
        assert sleep_until(lambda: link.counters.tx_dropped == 1, 30.0)
        assert link.counters.tx_messages == 0


def test_neither_threads_nor_descriptors_leak() -> None:
    def descriptors() -> set[str]:
        """Sockets and pipes by inode: what an earlier test's thread closes does not count."""
        found = set()
        for number in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError):
                found.add(os.readlink(f"/proc/self/fd/{number}"))
        return {name for name in found if name.startswith(("socket:", "pipe:"))}

    threads, before = set(threading.enumerate()), descriptors()
    for _ in range(20):
        link = Link(Endpoint.parse("udpin:127.0.0.1:0"), Recorder())
        link.start()
        assert sleep_until(lambda link=link: link.connected, 30.0)  # type: ignore[misc]
        link.stop()
    Link(Endpoint.parse("udpin:127.0.0.1:0"), Recorder()).stop()  # never started
    assert set(threading.enumerate()) <= threads
    assert descriptors() <= before
    with pytest.raises(BridgeStateError, match="already started"):
        link.start()


def test_waking_a_link_that_is_stopped_writes_into_nobody_elses_file(monkeypatch):
    """The pipe's number is soon another file's, a vehicle's record perhaps."""
    pipe = WakePipe()
    written: list[int] = []
    wakers = []

    def close_slowly(number: int) -> None:
        """Another thread wakes the link while its pipe is closed."""
        os.close(number)
        waker = threading.Thread(target=pipe.wake)
        wakers.append(waker)
        waker.start()
        waker.join(0.1)  # as far as it comes

    def note(number: int, data: bytes) -> int:
        written.append(number)
        return len(data)

    number = pipe.write_end
    pipe.wake()
    system = SimpleNamespace(close=close_slowly, write=note)
    monkeypatch.setattr("mavlink_bridge.link.waking.os", system)
    pipe.close()
    for waker in wakers:
        waker.join(30.0)
    pipe.wake()
    assert len(wakers) == 2
    assert number not in written


# --- streams ------------------------------------------------------------------------------------


class Asking:
    """A keeper of streams, and what it asks for."""

    def __init__(self) -> None:
        self._asked: list[float] = []
        commander: Any = SimpleNamespace(send=self._send)
        self.keeper = StreamKeeper(BridgeConfig(), commander)

    def _send(self, _: Any, command: int, message_id: float, *__: float) -> None:
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._asked.append(message_id)

    def at(self, now_s: float) -> set[str]:
        """Names of the messages that are asked for."""
        self._asked.clear()
        state = VehicleState(autopilot="ardupilot")
        self.keeper.tick(None, state, int(now_s * SECOND))  # type: ignore[arg-type]
        return {mavlink.mavlink_map[int(number)].msgname for number in self._asked}


def test_streams_are_asked_once_while_they_flow_and_again_when_they_stop() -> None:
    asking = Asking()
    assert "ATTITUDE" in asking.at(10.0)
    for t in range(11, 20):
        asking.keeper.on_message("ATTITUDE", t * SECOND)
        assert "ATTITUDE" not in asking.at(t + 0.5)
    assert "ATTITUDE" in asking.at(25.0)


def test_old_gimbal_message_is_asked_for_only_when_the_new_one_stays_silent() -> None:
    silent, flowing = Asking(), Asking()
    asked = [silent.at(10.0 + 2.5 * i) for i in range(12)]
    new, old = "GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_STATUS"
    assert [new in a for a in asked[:4]] == [True, True, False, False]
    assert old not in asked[0] | asked[1]
    assert sum(old in a for a in asked) == 2
    for t in range(10, 30):
        flowing.keeper.on_message(new, t * SECOND)
        assert old not in flowing.at(t + 0.1)


def test_evidence_that_an_autopilot_did_not_hear_of_is_asked_for_again() -> None:
    """IMU and barometer were asked for twice in the first seconds, while it still booted, and the
    monitor flew without either, untold. One that does not know them is asked once a minute.
    """
    asking = Asking()
    asked = ["RAW_IMU" in asking.at(10.0 + 2.5 * i) for i in range(90)]
    assert asked[:4] == [True, True, False, False]
    assert 2 < sum(asked) <= 5


def test_streams_by_configuration() -> None:
    def wanted(autopilot: str, **options: Any) -> set[str]:
        return {s.name for s in wanted_streams(BridgeConfig(**options), autopilot)}

    by_need = {"RC_CHANNELS", "ESTIMATOR_STATUS", "CAMERA_SETTINGS"}
    assert not by_need & wanted("ardupilot")
    zooms = CameraConfig(zoom_rate_hz=5.0)
    assert by_need <= wanted("px4", mode="rc", camera=zooms)
    assert "EKF_STATUS_REPORT" in wanted("ardupilot") - wanted("px4")


def heard(server: socket.socket, reader: FrameReader) -> set[str]:
    """Accepts one connection, listens until a message passes, and closes it."""
    connection, _ = server.accept()
    with connection:
        connection.settimeout(30.0)
        while not (messages := reader.feed(connection.recv(4096))):
            pass
    return {m.get_type() for m in messages}


def test_a_key_file_that_changes_while_the_link_runs_changes_nothing(tmp_path):
    """The key counts that was read at the start, over every reconnection, until the next start."""
    path = tmp_path / "key"
    reader = FrameReader(key=create_key(path))
    with listen() as server:
        settings = BridgeConfig(
            connection=f"tcp:127.0.0.1:{server.getsockname()[1]}",
            system_id=1,
            signing=SigningConfig(key_file=path),
        )
        with Bridge(settings, 0.0) as bridge:
            assert "HEARTBEAT" in heard(server, reader)
            path.unlink()
            create_key(path)
            assert heard(server, reader)
            assert int(bridge.counters()["fc_opened"] or 0) >= 2
    assert reader.counters.bad_signatures == 0
