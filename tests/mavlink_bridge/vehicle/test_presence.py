"""A flight controller that goes silent is told in seconds, whatever its link is doing."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from functools import partial
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, HealthLevel, VehicleState
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.link.link import Link, LinkOptions, sleep_until
from mavlink_bridge.link.transport import Endpoint, Transport, open_transport
from mavlink_bridge.status import OperatorStatus
from mavlink_bridge.vehicle_events import VehicleWatch
from tests.mavlink_bridge.simulated import lengths

HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3)


class Ticks:
    """Handler that counts its ticks and sends something with each."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.sent: list[bool] = []

    def on_open(self, link: Link) -> None: ...

    def on_message(self, link: Link, message: Any, time_ns: int) -> None: ...

    def on_tick(self, link: Link, now_ns: int) -> int:
        self.times.append(now_ns * 1e-9)
        self.sent.append(link.send(HEARTBEAT, 191))
        return now_ns + 100_000_000


def test_the_handlers_clock_goes_on_while_the_transport_is_closed(monkeypatch):
    """Half a minute of simulated time, which only the link's thread moves."""
    now_ns = [10**12]
    monkeypatch.setattr("mavlink_bridge.link.link.monotonic_ns", lambda: now_ns[0])
    attempts: list[float] = []

    def refuse(_: Endpoint) -> Any:
        attempts.append(now_ns[0] * 1e-9)
        raise ConnectionRefusedError("nobody there")

    class Stop(threading.Event):
        """The link's event, whose waiting is what moves the clock."""

        def is_set(self) -> bool:
            return now_ns[0] > 10**12 + 30 * 10**9

        def wait(self, timeout: float | None = None) -> bool:
            now_ns[0] += int((timeout or 0.0) * 1e9) + 1
            return self.is_set()

    ticks = Ticks()
    link = Link(Endpoint.parse("tcp:127.0.0.1:9"), ticks, LinkOptions(opener=refuse, stop=Stop()))
    link.system_id = 1
    for _ in range(700):
        link.send(HEARTBEAT, 191)
    link.start()
    link.stop()
    assert lengths(link)["outbox"] == 0
    waits = [b - a for a, b in itertools.pairwise(attempts)]
    assert max(waits) == pytest.approx(5.0, abs=0.01)  # a tick at each attempt only would leave it
    assert max(b - a for a, b in itertools.pairwise(ticks.times)) <= 0.21
    assert not any(ticks.sent)
    assert link.counters.tx_dropped >= 700


class Pair:
    """A transport of a socket pair, into which somebody has said something or not."""

    stream = True

    def __init__(self, said: bytes) -> None:
        self.socket, self.other = socket.socketpair()
        self.other.sendall(said)

    def fileno(self) -> int:
        return self.socket.fileno()

    def read(self) -> bytes:
        raise RuntimeError("a driver's bug")

    def write(self, data: bytes) -> int:
        raise ConnectionResetError("reset by peer")

    def close(self) -> None:
        self.socket.close()
        self.other.close()


@pytest.mark.parametrize(("said", "failures"), [(b"x", 3), (b"", 0)])
def test_an_error_of_the_transport_costs_the_connection_and_not_the_link(said, failures):
    """Of a read one that nobody foresaw; of a write one that ends the connection at once, and is no
    error of the handler.
    """
    options = LinkOptions(opener=lambda _: Pair(said))
    link = Link(Endpoint.parse("tcp:127.0.0.1:9"), Ticks(), options)
    link.system_id = 0 if said else 1
    link.start()
    assert sleep_until(
        lambda: link.counters.opened >= 3 and link.counters.failures >= failures, 30.0
    )
    link.stop()
    assert link.counters.handler_errors == 0
    assert (link.counters.failures > 0) == (failures > 0)


def test_loss_is_told_on_the_ground_link_within_seconds(monkeypatch):
    """The connection attempt itself hangs, as one to a host that is gone does."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station,
        socket.create_server(("127.0.0.1", 0)) as server,
    ):
        station.bind(("127.0.0.1", 0))
        config = BridgeConfig(
            connection=f"tcp:127.0.0.1:{server.getsockname()[1]}",
            ground_connection=f"udpout:127.0.0.1:{station.getsockname()[1]}",
        )
        codec, over = mavlink.MAVLink(None, 255, 190), threading.Event()
        texts: list[str] = []
        attempts: list[Endpoint] = []

        def opened(endpoint: Endpoint) -> Transport:
            if endpoint in attempts:
                over.wait()
                raise ConnectionRefusedError("nobody there")
            attempts.append(endpoint)
            return open_transport(endpoint)

        monkeypatch.setattr(
            "mavlink_bridge.bridge.LinkOptions", partial(LinkOptions, opener=opened)
        )
        with Bridge(config, 0.0) as bridge:
            client, _ = server.accept()
            spoke_at = time.monotonic()
            client.sendall(HEARTBEAT.pack(mavlink.MAVLink(None, 1, 1)))
            assert sleep_until(lambda: bridge.state().connected, 30.0)
            client.close()
            server.close()
            station.settimeout(0.1)

            def told() -> bool:
                with contextlib.suppress(TimeoutError):
                    for m in codec.parse_buffer(station.recv(65536)) or []:
                        texts.extend([m.text] if m.get_type() == "STATUSTEXT" else [])
                return any("lost" in text for text in texts)

            # A link that waited for its connection, or for TCP, would need minutes.
            assert sleep_until(told, 30.0, step_s=0.0)
            assert time.monotonic() - spoke_at > 3.0
            over.set()
            assert [a.id for a in bridge.alerts()].count(AlertId.FC_LOST) == 1


def test_a_vehicle_that_never_speaks_is_told() -> None:
    """Five seconds after the first tick, however long the application took to get there."""
    now_ns = [10**12]
    told: list[Alert] = []
    watch = VehicleWatch(told.append, clock=lambda: now_ns[0])
    for seconds, connected, texts in ((100, False, 0), (4, False, 0), (2, False, 1), (1, True, 2)):
        now_ns[0] += seconds * 10**9
        watch.check(VehicleState(connected=connected))
        assert len(told) == texts
    assert [a.id for a in told] == [AlertId.FC_SILENT, AlertId.FC_FOUND]


def test_what_the_operator_reads_is_logged_and_recorded_once(autopilot, caplog):
    recorded: list[Alert] = []
    degraded = alert(AlertId.DEGRADED)
    bridging = [alert(AlertId.BRIDGING, seconds=s, metres=9.0) for s in (3.0, 4.0, 5.0)]
    config = BridgeConfig(connection=f"udpout:127.0.0.1:{autopilot.port}")
    bridge = Bridge(config, 0.0, on_alert=recorded.append)
    with caplog.at_level("INFO"):
        for _ in range(3):
            bridge.set_health(HealthLevel.DEGRADED, [degraded])
        for news in bridging:
            bridge.set_health(HealthLevel.DEGRADED, [news])
        bridge.set_health(HealthLevel.DEGRADED, [alert(AlertId.FC_SILENT)], tell=False)
    bridge.stop()
    lines = [r.getMessage() for r in caplog.records if "localization" in r.getMessage()]
    assert lines == [text(degraded)]
    assert recorded == [degraded, bridging[0]]


def test_an_overloaded_computer_is_told_once_and_not_every_second() -> None:
    """Well and ill by turns for a minute: each bad text once in 10 s, the end once it lasts.
    What is worse is told at once.
    """
    told, now_ns = list[Alert](), [0]
    status = OperatorStatus(lambda *_: None, told.append, lambda: now_ns[0])
    tracking, failed = alert(AlertId.TRACKING), alert(AlertId.NO_FRAME)

    def report(at_s: int, level: HealthLevel, news: Alert) -> None:
        now_ns[0] = at_s * 10**9
        status.set_health(level, [news], tell=True)
        assert status.level is level  # the heartbeats say what is

    report(0, HealthLevel.OK, tracking)
    for at_s in range(1, 61):
        if at_s % 2:
            overloaded = alert(AlertId.OVERLOADED, done=float(at_s % 3), offered=10.0)
            report(at_s, HealthLevel.DEGRADED, overloaded)
        else:
            report(at_s, HealthLevel.OK, tracking)
    assert told == [tracking, alert(AlertId.OVERLOADED, done=1.0, offered=10.0)]  # of 60
    for at_s in range(61, 66):
        report(at_s, HealthLevel.OK, tracking)
    assert told[2:] == [tracking]
    report(66, HealthLevel.FAILED, failed)
    report(67, HealthLevel.OK, tracking)
    report(68, HealthLevel.FAILED, failed)
    assert told[3:] == [failed]


def test_a_loss_that_returns_is_reported_beside_an_alert_that_stays() -> None:
    """While the search hangs, only the first of five losses was sent."""
    told, now_ns = list[Alert](), [0]
    status = OperatorStatus(lambda *_: None, told.append, lambda: now_ns[0])
    hangs, lost = alert(AlertId.SEARCH_HANGS), alert(AlertId.NO_FRAME)
    for at_s in range(0, 300, 60):
        now_ns[0] = at_s * 10**9
        status.set_health(HealthLevel.FAILED, [lost, hangs], tell=True)
        now_ns[0] += 30 * 10**9
        status.set_health(HealthLevel.DEGRADED, [hangs], tell=True)
    assert told == [lost, hangs, *[lost] * 4]
