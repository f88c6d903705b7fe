"""The flight's side of the console: it never waits, whatever the other side does."""

import asyncio
import contextlib
import errno
import json
import os
import socket
import stat
import threading
import time
from typing import Any

import numpy as np
import pytest

from companion.console.source import FlightSource
from companion.errors import CompanionError
from companion.live.orders import OrderContext, OrderError, Orders
from companion.live.protocol import (
    LinkError,
    MessageDecoder,
    SharedMemoryReader,
    encode,
    runtime_folder,
    socket_path,
)
from companion.live.publisher import Publisher, RateLimiter
from companion.live.shown import ConsoleData, Instruments
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.types import Frame
from mavlink_bridge.alerts.catalogue import alert, body
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.injection.outcome import LoopVerdict
from mavlink_bridge.injection.shadow import ShadowScore
from mavlink_bridge.messages import VehicleState
from tests.companion.estimates import CAMERA, estimated

FRAME = LocalFrame(Geodetic(47.0, 8.0, 400.0))


def _shown():
    instruments = Instruments(
        lambda: {"level": "ok", "text": "", "rate_hz": float("nan")}, VehicleState,
        lambda: ShadowScore(False, 0, (alert(AlertId.SHADOW_NOT_COMPARED),)),
        lambda: LoopVerdict(False, alert(AlertId.EKF_NO_SOURCE), None), lambda: False,
    )  # fmt: skip
    return ConsoleData(FRAME, 48.0, instruments, {"mode": "shadow"})


class Ship:
    """What orders reach."""

    def __init__(self):
        self.said: list[Any] = []
        self.tracked: list[Any] = []
        self.hints: list[Any] = []
        self.helm = OrderContext(self.said.append, self.tracked.append,
                         lambda *hint: self.hints.append(hint))  # fmt: skip


@pytest.fixture
def serving(tmp_path):
    ship, shown = Ship(), _shown()
    publisher = Publisher(tmp_path / "s", shown, Orders(True, ship.helm), 15.0)
    publisher.start()
    yield publisher, shown, ship
    publisher.stop()
    publisher.close()


class Console:
    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(30.0)
        self.socket.connect(str(path))
        self.arrivals = SharedMemoryReader(self.socket)
        self._decoder = MessageDecoder()
        self._messages = []

    def send(self, head):
        self.socket.sendall(encode(head))

    def next(self, kind):
        while (message := self.poll(kind)) is None:
            pass
        return message

    def poll(self, kind):
        """The next message of that kind, if it is whole with what comes next."""
        found = self._found(kind)
        if found is None:
            data = self.arrivals.receive(1 << 20)
            if not data:
                raise EOFError
            self._messages += self._decoder.feed(data)
            found = self._found(kind)
        return found

    def has(self, kind):
        return any(message.head["kind"] == kind for message in self._messages)

    def _found(self, kind):
        for i, message in enumerate(self._messages):
            if message.head["kind"] == kind:
                return self._messages.pop(i)
        return None


def _estimate(number):
    pose = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
    return estimated(pose, number, variance=1.0, quality=0.5, sequence=number, last_fix_ns=number)


def _give(publisher, shown, number):
    image = np.full((480, 640, 3), number % 256, np.uint8)
    shown.add_frame(Frame(image, number, CAMERA, number))
    shown.add_estimate(_estimate(number), None)
    publisher.wake()


def _watching(publisher):
    console = Console(publisher.path)
    console.next("hello")
    console.send({"kind": "watch", "frames": True})
    return console


def _given(publisher, shown, console, number):
    """Give pictures until the console has one; its message, and the number of the last."""
    while True:
        number += 1
        _give(publisher, shown, number)
        console.send({"do": "nothing", "number": number})  # answered: so something always comes
        if (message := console.poll("frame")) is not None:
            return message, number


def test_a_console_that_stands_still_gets_the_newest_picture_and_none_of_those_between(serving):
    publisher, shown, _ = serving
    console = _watching(publisher)
    message, number = _given(publisher, shown, console, 0)
    first = np.frombuffer(console.arrivals.read(message.head["shared"]), np.uint8)
    # It has not said that it read: whatever it is kept waiting with, no picture is.
    stood_at = number
    while not console.has("state") or number < stood_at + 50:
        number += 1
        _give(publisher, shown, number)
        console.send({"do": "nothing", "number": number})
        console.next("answer")
        assert not console.has("frame")
    still = np.frombuffer(console.arrivals.read(message.head["shared"]), np.uint8)
    assert np.array_equal(first, still)  # nor is what it looks at overwritten
    console.send({"kind": "read"})
    message, number = _given(publisher, shown, console, number)
    assert message.head["exposure_ns"] >= stood_at + 50  # the newest there was, or newer
    data = np.frombuffer(console.arrivals.read(message.head["shared"]), np.uint8)
    assert data.size == 640 * 480 * 3
    assert np.all(data == message.head["exposure_ns"] % 256)


def test_a_console_that_cuts_its_memory_short_harms_itself_alone(serving):
    publisher, shown, _ = serving
    bad = _watching(publisher)
    message, number = _given(publisher, shown, bad, 0)
    for name in os.listdir("/proc/self/fd"):  # the console's copy is of this process, too
        with contextlib.suppress(OSError):
            if "console picture" in os.readlink(f"/proc/self/fd/{name}"):
                os.ftruncate(int(name), 0)
    with pytest.raises(LinkError, match="of which 0"):
        bad.arrivals.read(message.head["shared"])
    with pytest.raises(LinkError, match="without memory"):
        bad.arrivals.read(1 << 40)
    bad.send({"kind": "read"})
    message, _ = _given(publisher, shown, bad, number)  # the flight goes on
    assert len(bad.arrivals.read(message.head["shared"])) == 640 * 480 * 3


def test_the_consoles_own_process_standing_still_shows_the_newest_afterwards(serving):
    publisher, shown, _ = serving

    async def run():
        source = FlightSource(publisher.path)
        source.watch(True)
        task = asyncio.create_task(source.run())
        number = 0

        async def until(holds):
            nonlocal number
            while not holds():
                number += 1
                _give(publisher, shown, number)
                await asyncio.sleep(0)

        await until(lambda: source.newest.frames >= 1)
        witness = await asyncio.to_thread(_watching, publisher)
        before = source.newest.frames
        for _ in range(3):  # three more pictures go out meanwhile: this loop takes none of them
            _, number = _given(publisher, shown, witness, number)
            witness.send({"kind": "read"})
        stood_until = number
        # At most one of then waits for it; what comes next is the newest.
        await until(lambda: source.newest.frames >= before + 2)
        assert source.newest.frame.head["exposure_ns"] >= stood_until
        assert source.newest.frame.body == bytes(
            [source.newest.frame.head["exposure_ns"] % 256]
        ) * (640 * 480 * 3)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    asyncio.run(asyncio.wait_for(run(), 60))


GARBAGE = (b"\xff" * 64, b"\0\0\x10\0\0\0\0\0x", b"\0\0\0\2\0\0\0\0[]")


@pytest.mark.parametrize("garbage", GARBAGE)
def test_garbage_ends_that_console_alone(serving, garbage):
    publisher, _, ship = serving
    bad = Console(publisher.path)
    bad.next("hello")
    bad.socket.sendall(garbage + b"\0" * 8000)
    with pytest.raises((EOFError, ConnectionError)):
        bad.next("never")
    good = Console(publisher.path)
    assert good.next("state").head["health"]["rate_hz"] is None  # NaN is no JSON
    hint = {"do": "hint", "latitude_deg": 47.0, "longitude_deg": 8.0, "radius_m": 50}
    good.send(hint | {"number": 7})
    answer = good.next("answer").head
    assert (answer["number"], answer["ok"]) == (7, True)
    assert ship.hints == [(47.0, 8.0, 50.0)]
    assert ship.said == [alert(AlertId.CONSOLE_HINT, latitude=47.0, longitude=8.0, metres=50.0)]


def test_who_cannot_be_let_in_does_not_make_the_link_spin(serving, monkeypatch):
    """Out of file descriptors: the connection waits, and its socket stays readable."""
    publisher, _, _ = serving
    console = Console(publisher.path)
    console.next("hello")
    refusals, refused = [], threading.Event()

    def out_of_files(_):
        refusals.append(1)
        refused.set()
        raise OSError(errno.EMFILE, "Too many open files")

    with monkeypatch.context() as patched:
        patched.setattr(socket.socket, "accept", out_of_files)
        late = Console(publisher.path)
        assert refused.wait(30.0)
        for number in range(50):  # each is at least one turn of the link
            console.send({"do": "nothing", "number": number})
            console.next("answer")
    assert len(refusals) < 50
    late.next("hello")  # let in once it can be


def test_more_consoles_than_a_few_are_sent_away(serving):
    publisher, *_ = serving
    consoles = [Console(publisher.path) for _ in range(3)]
    for console in consoles:
        console.next("hello")
    with pytest.raises((EOFError, ConnectionError)):
        Console(publisher.path).next("hello")


def test_the_socket_is_this_users_alone(serving, tmp_path, monkeypatch):
    publisher, *_ = serving
    assert stat.S_IMODE(publisher.path.stat().st_mode) == 0o600
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert stat.S_IMODE(runtime_folder().stat().st_mode) == 0o700
    assert len(str(socket_path(tmp_path / ("m" * 200), None, "127.0.0.1:1").name)) < 30
    (tmp_path / "companion").chmod(0o777)  # somebody else may have laid a socket there
    with pytest.raises(LinkError, match="0700"):
        runtime_folder()


def test_events_are_told_once():
    shown = _shown()
    shown.add_event("info", "one")
    first, told = shown.state(0)
    shown.add_event("warning", "two")
    second, _ = shown.state(told)
    assert [e["text"] for e in first["events"]] == ["one"]
    assert [e["text"] for e in second["events"]] == ["two"]


@pytest.mark.parametrize(
    "order",
    [
        {"do": "arm"}, {}, {"do": ["target"]},
        {"do": "target", "x": 1.5, "y": 0.5}, {"do": "target", "x": True, "y": 0},
        {"do": "target", "x": float("nan"), "y": 0.5}, {"do": "target", "x": "0.5", "y": 0.5},
        {"do": "target", "x": 10**400, "y": 0.5},
        {"do": "box", "left": 0.5, "top": 0.1, "right": 0.4, "bottom": 0.2},
        {"do": "hint", "latitude_deg": 91, "longitude_deg": 8, "radius_m": 50},
        {"do": "hint", "latitude_deg": 47, "longitude_deg": 8, "radius_m": 1e9},
    ],
)  # fmt: skip
def test_an_order_that_makes_no_sense_is_refused(order):
    ship = Ship()
    with pytest.raises(OrderError):
        Orders(True, ship.helm).execute(order)
    assert (ship.said, ship.tracked, ship.hints) == ([], [], [])


@pytest.mark.parametrize("away_s", [-30.0, -10.1, 5.0, 1e9, float("nan"), "then", True])
@pytest.mark.parametrize(
    "order",
    [
        {"do": "target", "x": 0.5, "y": 0.5},
        {"do": "box", "left": 0.1, "top": 0.1, "right": 0.4, "bottom": 0.2},
    ],
)
def test_a_click_into_a_picture_that_is_not_of_now_is_refused(order, away_s):
    """On a page that had stood still it was taken for one into the present picture, and what lay
    there by then became the target.
    """
    ship, now_ns = Ship(), time.monotonic_ns()
    told = away_s if isinstance(away_s, str | bool) else now_ns + away_s * 1e9
    with pytest.raises(OrderError, match=r"click into a newer one|exposure_ns"):
        Orders(True, ship.helm).execute({**order, "exposure_ns": told})
    assert ship.tracked == []
    Orders(True, ship.helm).execute({"do": "stop", "exposure_ns": told})  # targets end all the same
    assert len(ship.tracked) == 1


@pytest.mark.parametrize("away_s", [-9.0, -0.2, 0.004, None])
def test_a_click_bears_the_time_of_its_picture(away_s):
    ship, now_ns = Ship(), time.monotonic_ns()
    told = None if away_s is None else now_ns + round(away_s * 1e9)
    Orders(True, ship.helm).execute({"do": "target", "x": 0.5, "y": 0.5, "exposure_ns": told})
    (request,) = ship.tracked
    assert now_ns - 9.1e9 < request.time_ns <= time.monotonic_ns()
    if away_s is not None and away_s < 0:
        assert request.time_ns == told


@pytest.mark.parametrize(
    ("order", "told"),
    [
        ({"do": "stop"}, alert(AlertId.CONSOLE_STOP)),
        ({"do": "target", "x": 0.5, "y": 0.25}, alert(AlertId.CONSOLE_TARGET, x=0.5, y=0.25)),
        ({"do": "hint", "latitude_deg": 47.5, "longitude_deg": 8.25, "radius_m": 50},
         alert(AlertId.CONSOLE_HINT, latitude=47.5, longitude=8.25, metres=50.0)),
    ],
)  # fmt: skip
def test_every_order_is_told_to_the_operator(order, told):
    ship = Ship()
    Orders(True, ship.helm).execute(order)
    assert ship.said == [told]
    assert {t.asked_by for t in ship.tracked} <= {"console"}  # so is the target called


def test_without_control_and_beyond_the_rate_nothing_is_done():
    ship = Ship()
    with pytest.raises(OrderError, match="only reads"):
        Orders(False, ship.helm).execute({"do": "stop"})
    now = [0.0]
    orders = Orders(True, ship.helm, lambda: now[0])
    for _ in range(10):
        orders.execute({"do": "stop"})
    with pytest.raises(OrderError, match="more than 10"):
        orders.execute({"do": "stop"})
    now[0] = 6.0
    orders.execute({"do": "stop"})
    assert len(ship.tracked) == 11
    assert issubclass(OrderError, CompanionError)


def test_alerts_reach_the_console_as_ids_and_their_text():
    document = json.loads(json.dumps(_shown().state(0)[0]))
    assert document["follows"]["reason"] == body(alert(AlertId.EKF_NO_SOURCE))
    assert document["shadow"]["reasons"][0]["id"] == AlertId.SHADOW_NOT_COMPARED.value


# --- The rate of pictures on the page is the one that was asked for -----------------------------


@pytest.mark.parametrize(("fed_hz", "asked_hz", "sent_hz"), [(10, 6, 6), (10, 15, 10), (30, 6, 6)])
def test_the_mean_rate_is_what_was_asked_for(fed_hz, asked_hz, sent_hz):
    pace, sent = RateLimiter(1.0 / asked_hz), 0
    for i in range(100 * fed_hz):
        if pace.is_due(1000.0 + i / fed_hz):
            pace.mark_sent(1000.0 + i / fed_hz)
            sent += 1
    assert sent / 100 == pytest.approx(sent_hz, rel=0.02)
