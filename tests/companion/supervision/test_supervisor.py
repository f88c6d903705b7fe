"""The flight process dies: told, marked, taken over by the standby, and not for ever."""

from __future__ import annotations

import configparser
import errno
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from companion.config import CompanionConfig, parse_config
from companion.flight.channels import Feed
from companion.supervision.processes import (
    ENDING,
    Beat,
    FlightProcess,
    Pulse,
    ServiceManager,
    line,
    without_lost_disks,
    write_problem,
)
from companion.supervision.supervisor import RestartPolicy, Supervisor, exit_code_text, mark_dead
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, body
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name, ProcessFault

DIED = alert(AlertId.COMPANION_RESTARTS, how=ProcessFault.DIED, what=Name("SIGKILL"))


def hanging(what: str) -> Alert:
    return alert(AlertId.COMPANION_RESTARTS, how=ProcessFault.HANGS, what=Name(what))


@dataclass
class Scripted:
    """A process that flies for so many looks and ends with a code."""

    looks: int
    code: int
    standby: bool = False
    pid: int = 1
    released: bool = False
    dismissed: bool = False
    signals: list[int] = field(default_factory=list)
    says: Callable[[int], Beat | None] = lambda _: Beat("all", 0.1)
    killed: bool = False
    then: tuple[int, Callable[[], None]] = (-1, lambda: None)
    """What happens when so many looks are left."""

    def beats(self) -> tuple[Beat, ...]:
        beat = self.says(self.looks)
        return () if beat is None else (beat,)

    def kill(self) -> None:
        self.killed = True

    def close(self) -> None:
        pass

    def release(self) -> None:
        self.released = True

    def wait(self, _: float) -> int | None:
        at, happens = self.then
        if self.looks == at:
            happens()
        self.looks -= 1
        return None if self.looks >= 0 else self.code

    def send_signal(self, number: int) -> None:
        self.signals.append(number)
        self.looks, self.code = 0, 0

    def dismiss(self) -> None:
        self.dismissed = True


class Noted:
    """What the service manager is told, in order."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def ready(self) -> None:
        self.said.append("ready")

    def alive(self) -> None:
        self.said.append("alive")

    def status(self, text: str) -> None:
        self.said.append(text)


class Stage:
    """Hands out processes in order; each look takes half a second, a quarter without beats."""

    def __init__(self, flights: Sequence[Scripted], **policy: float) -> None:
        self.waiting = list(flights)
        self.spawned: list[Scripted] = []
        self.told: list[Alert] = []
        self.marked: list[str] = []
        self._now_s = 0.0
        self.refusals = 0
        self.waited_s = 0.0
        self.stops_after_s = float("inf")
        self.manager = Noted()
        self._policy = RestartPolicy(**policy)  # type: ignore[arg-type]
        self.supervisor = self.made()

    def made(
        self,
        tell: Callable[[Alert], None] | None = None,
        mark: Callable[[int, str], None] | None = None,
    ) -> Supervisor:
        """A supervisor of these processes."""
        return Supervisor(
            self._spawn,
            tell or self.told.append,
            mark or (lambda _, text: self.marked.append(text)),
            self._policy,
            self.manager,
            self._clock,
            self._wait,
        )

    def _spawn(self, standby: bool) -> Any:
        if self.refusals > 0 and self.spawned:
            self.refusals -= 1
            raise BlockingIOError(11, "Resource temporarily unavailable")
        process = self.waiting.pop(0)
        process.standby = standby
        self.spawned.append(process)
        return process

    def sleep(self, seconds: float) -> None:
        """Time goes by."""
        self._now_s += seconds

    def _wait(self, seconds: float) -> None:
        self.waited_s += seconds
        self.sleep(seconds)
        if self.waited_s >= self.stops_after_s:
            self.supervisor.stop(signal.SIGTERM)

    def _clock(self) -> float:
        self._now_s += 0.25
        return self._now_s


def test_a_death_is_told_marked_and_the_standby_flies_on() -> None:
    stage = Stage([Scripted(30, -9), Scripted(20, 0), Scripted(9, 0)], standby_after_s=5.0)
    assert stage.supervisor.run() == 0
    first, second, third = stage.spawned
    assert (first.standby, second.standby, third.standby) == (False, True, True)
    assert second.released
    assert third.dismissed  # the second's own
    assert not third.released
    assert stage.told == [DIED]
    assert stage.marked == ["companion died (SIGKILL), restarting"]


@pytest.mark.parametrize("what", ["tell", "mark"])
@pytest.mark.parametrize("standby_after_s", [5.0, 60.0])
def test_a_disk_or_a_port_that_stands_still_keeps_no_flight_waiting(
    what: str, standby_after_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The supervisor waited for the dead record's disk before it started the next process."""
    monkeypatch.setattr("companion.supervision.supervisor._WORDS_S", 0.01)
    stage = Stage(
        [Scripted(30, -9), Scripted(9, 0), Scripted(9, 0)], standby_after_s=standby_after_s
    )
    still, ended = threading.Event(), threading.Event()

    def stands(*_: object) -> None:
        still.wait(120.0)

    supervisor = stage.made(**{what: stands})
    flying = threading.Thread(target=lambda: (supervisor.run(), ended.set()), daemon=True)
    flying.start()
    try:
        assert ended.wait(60.0)
    finally:
        still.set()
    assert len(stage.spawned) >= 2
    assert stage.spawned[1].looks < 0  # it was watched


def test_quick_deaths_never_end_it_and_cold_starts_wait_longer_and_longer() -> None:
    """It gave up at the fifth: under denial nobody would have flown on."""
    stage = Stage([*(Scripted(2, 1) for _ in range(9)), Scripted(2, 0)], standby_after_s=1e3)
    assert stage.supervisor.run() == 0
    assert len(stage.spawned) == 10
    how = (ProcessFault.DIED, "exit 1")
    waits = [how] * 4 + [(*how, float(s)) for s in (2, 4, 8, 16, 30)]
    assert [told.values for told in stage.told] == waits
    assert stage.waited_s == 2 + 4 + 8 + 16 + 30
    assert stage.marked == [body(told) for told in stage.told]


def test_a_standby_takes_over_at_once_however_many_died() -> None:
    """The wait is for the processors that a cold start takes."""
    stage = Stage([*(Scripted(30, -9) for _ in range(8)), Scripted(0, 0)], standby_after_s=2.0)
    stage.waiting += [Scripted(9, 0) for _ in range(3)]
    assert stage.supervisor.run() == 0
    assert {told.id for told in stage.told} == {AlertId.COMPANION_RESTARTS}
    assert stage.waited_s == 0.0


def test_an_order_to_end_is_obeyed_while_it_waits() -> None:
    stage = Stage([Scripted(2, 1) for _ in range(9)], standby_after_s=1e3)
    stage.stops_after_s = 5.0
    assert stage.supervisor.run() == 1
    assert 5.0 <= stage.waited_s < 6.0


def test_a_standby_that_cannot_be_started_ends_nothing() -> None:
    stage = Stage([Scripted(60, 0), Scripted(9, 0)], standby_after_s=5.0)
    stage.refusals = 1
    assert stage.supervisor.run() == 0
    assert [p.standby for p in stage.spawned] == [False, True]  # tried again later


@pytest.mark.parametrize("refusals", [2, 9])
def test_a_computer_without_a_process_to_give_is_asked_again(refusals: int) -> None:
    stage = Stage([Scripted(3, -9), Scripted(3, 0)], standby_after_s=60.0)
    stage.refusals = refusals
    assert stage.supervisor.run() == 0
    assert stage.told == [DIED]
    assert stage.waited_s == sum(min(2**i, 30) for i in range(refusals))


def test_a_wrong_configuration_is_not_tried_again() -> None:
    stage = Stage([Scripted(2, 2)])
    assert stage.supervisor.run() == 2
    assert stage.told == []


def test_an_order_to_end_is_passed_on_and_the_standby_dismissed() -> None:
    stage = Stage([Scripted(10**6, -9), Scripted(10**6, 0)], standby_after_s=2.0)
    stage.waiting[0].then = (10**6 - 20, lambda: stage.supervisor.stop(signal.SIGTERM))
    assert stage.supervisor.run() == 0
    assert stage.spawned[0].signals == [signal.SIGTERM]
    assert stage.spawned[1].dismissed
    assert stage.told == []


def test_what_cannot_be_told_does_not_keep_it_from_flying() -> None:
    flights: list[Any] = [Scripted(1, -9), Scripted(1, 0)]

    def fails(*_: object) -> None:
        raise OSError("no such port")

    supervisor = Supervisor(lambda _: flights.pop(0), fails, fails)
    assert supervisor.run() == 0


_CHILD = """
import os, pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1])
if "--standby" in sys.argv:
    (folder / "ready").touch()
    sys.exit(0 if sys.stdin.readline() == "fly\\n" else 7)
while not (folder / "ready").exists():
    time.sleep(0.01)
os.kill(os.getpid(), signal.SIGKILL)
"""


def _supervised(policy: RestartPolicy, *script: str) -> list[Alert]:
    """What is told of real processes that run it, until the last has ended well."""
    told: list[Alert] = []
    command = [sys.executable, "-S", "-c", *script]

    def begin(standby: bool) -> FlightProcess:
        return FlightProcess(command, standby=standby)

    assert Supervisor(begin, told.append, lambda *_: None, policy).run() == 0
    return told


def test_real_processes_killed_and_released(tmp_path: Path) -> None:
    """kill -9 on the one that flies; the standby takes over and ends in order."""
    assert _supervised(RestartPolicy(standby_after_s=0.0), _CHILD, str(tmp_path)) == [DIED]


@pytest.mark.parametrize(
    ("says", "hangs"),
    [
        (lambda looks: Beat("localize", 20.0 - looks), "localize"),  # a part that blocks for ever
        (lambda looks: Beat("all", 0.0) if looks > 15 else None, "process"),  # SIGSTOP, a lock
        (lambda looks: Beat("link fc", 3.9 if looks % 2 else 0.0), ""),  # slow, and goes on
    ],
)
def test_what_hangs_is_told_ended_and_taken_over(says, hangs):
    flights = [Scripted(20, 0, says=says), Scripted(20, 0), Scripted(9, 0)]
    stage = Stage(flights, standby_after_s=1.0)
    assert stage.supervisor.run() == 0
    told = [hanging(hangs)] if hangs else []
    assert stage.spawned[0].killed == bool(hangs)
    assert stage.spawned[1].released == bool(hangs)
    assert stage.marked == [body(of) for of in told]
    assert stage.told == told
    said = stage.manager.said
    for text in stage.marked:  # what hangs is not called alive, what follows is ready
        assert said[: said.index(text)].count("alive") == 20 - stage.spawned[0].looks - 1
        assert said[said.index(text) :].count("ready") == 1


def mute(_: int) -> None:
    """Says nothing."""


@pytest.mark.parametrize(("looks", "hangs"), [(200, False), (1000, True)])
def test_a_process_that_never_shows_life_is_ended_after_its_patience(looks, hangs):
    """Compiling takes minutes on a new machine; a standby that was released has compiled."""
    stage = Stage([Scripted(looks, 0, says=mute), Scripted(9, 0)], cold_s=120.0)
    assert stage.supervisor.run() == 0
    assert stage.told == ([hanging("process")] if hangs else [])
    # A cold start's patience is the supervisor's, not systemd's.
    assert hangs or stage.manager.said == ["alive"] * looks


def ends(word: str) -> Callable[[int], Beat | None]:
    """Says that word once, 20 looks before its end, and nothing more."""
    return lambda looks: (
        Beat("all", 0.1) if looks > 20 else Beat(word, 0.0) if looks == 20 else None
    )


@pytest.mark.parametrize(
    ("word", "policy", "waited_for"),
    [(ENDING, {}, True), ("failing", {}, False), (ENDING, {"ending_s": 4.0}, False)],
)
def test_an_end_in_order_takes_its_time_and_no_other(word, policy, waited_for):
    """A recording is closed: a kill would leave it in pieces, and fly again what was over."""
    stage = Stage([Scripted(40, 0, says=ends(word)), Scripted(3, 0)], standby_after_s=60, **policy)
    assert stage.supervisor.run() == 0
    assert stage.spawned[0].killed is not waited_for
    assert stage.told == ([] if waited_for else [hanging("process")])


def test_a_computer_that_slept_hangs_nothing() -> None:
    """Both processes stood still: the supervisor sees no signs of life at first."""
    quiet = {8, 9}  # looks after it, until the next sign comes
    process = Scripted(20, 0, says=lambda at: None if at in quiet else Beat("all", 0.0))
    stage = Stage([process], standby_after_s=1e3)
    process.then = (10, lambda: stage.sleep(60.0))
    assert stage.supervisor.run() == 0
    assert stage.told == []


@pytest.mark.parametrize("hangs", [False, True])
def test_a_part_that_slept_with_the_computer_has_its_time_after_it(hangs: bool) -> None:
    """Of a process that woke up the pulse had its turn before the others: it was ended for it."""

    def says(looks: int) -> Beat:
        slept = looks < 40 and (hangs or looks >= 38)
        return Beat("feed", 60.0 + 0.5 * (40 - looks) if slept else 0.0)

    process = Scripted(60, 0, says=says)
    stage = Stage([process, Scripted(9, 0)], standby_after_s=1e3)
    process.then = (40, lambda: stage.sleep(60.0))
    assert stage.supervisor.run() == 0
    assert stage.told == ([hanging("feed")] if hangs else [])


_HANGING = """
import os, signal, sys
pulse = next(int(one.partition("=")[2]) for one in sys.argv if one.startswith("--pulse="))
if "--standby" in sys.argv:
    sys.exit(0 if sys.stdin.readline() == "fly\\n" else 7)
os.write(pulse, b"all 0\\n")
if "stops" in sys.argv:
    os.kill(os.getpid(), signal.SIGSTOP)
while True:
    os.write(pulse, b"localize 9000\\n")
    signal.sigtimedwait([], 0.05)
"""


@pytest.mark.parametrize(("how", "what"), [("stops", "process"), ("blocks", "localize")])
def test_real_processes_that_stop_or_block_are_ended(how: str, what: str) -> None:
    policy = RestartPolicy(standby_after_s=0.0, silent_s=0.6)
    assert _supervised(policy, _HANGING, how) == [hanging(what)]


def test_a_standby_whose_supervisor_is_gone_ends(tmp_path: Path) -> None:
    (tmp_path / "ready").touch()
    standby = FlightProcess([sys.executable, "-S", "-c", _CHILD, str(tmp_path)], standby=True)
    standby.dismiss()
    assert standby.wait(0.0) == 7
    standby.release()  # harmless
    standby.send_signal(signal.SIGTERM)


@pytest.mark.parametrize(("code", "said"), [(-9, "SIGKILL"), (1, "exit 1"), (-200, "signal 200")])
def test_codes_in_words(code: int, said: str) -> None:
    assert exit_code_text(code) == said


@pytest.mark.parametrize("flight", ["flight", "[21] field *"])
def test_the_health_of_the_process_says_dead(tmp_path: Path, flight: str) -> None:
    """Of several flights the record of the process that died; without a record nothing."""
    for name, pid in ((flight, 11), (f"{flight}-2", 12)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "health.json").write_text(f'{{"level": "ok", "pid": {pid}}}')
    (tmp_path / f"{flight}-3").mkdir()  # of the standby, which does not report yet
    (tmp_path / f"{flight}-4").mkdir()
    (tmp_path / f"{flight}-4" / "health.json").write_text("{")
    before_ns = time.monotonic_ns()
    mark_dead(tmp_path / flight, 12, "companion died (SIGKILL), restarting")
    report = json.loads((tmp_path / f"{flight}-2" / "health.json").read_text())
    assert (report["level"], report["text"]) == ("failed", "companion died (SIGKILL), restarting")
    assert report["time_ns"] >= before_ns
    assert json.loads((tmp_path / flight / "health.json").read_text())["level"] == "ok"
    mark_dead(tmp_path / "nowhere" / "flight", 12, "dead")
    assert not (tmp_path / "nowhere").exists()


# --- the service manager --------------------------------------------------------------------------


def test_the_service_is_ready_once_every_part_took_a_turn() -> None:
    """Not with the first sign of life: the thread that localizes compiles for its first frame."""
    compiles: Callable[[int], Beat] = lambda left: Beat(  # noqa: E731
        "localize", 0.5 * (40 - left) if left > 33 else 0.1
    )
    flights = [Scripted(40, 0, says=compiles)]
    stage = Stage(flights, standby_after_s=1e3)
    assert stage.supervisor.run() == 0
    said = stage.manager.said
    assert said.count("ready") == 1
    assert said.index("ready") == said.index("flying") - 1 == 6  # after six looks that were alive


@pytest.mark.parametrize("address", ["{}/notify", "@pilot-test-{}"])
def test_systemd_is_told_over_its_socket(address: str, tmp_path: Path) -> None:
    where = address.format(tmp_path if "/" in address else os.getpid())
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(where.replace("@", "\0", 1))
        systemd.setblocking(False)
        environment = {"NOTIFY_SOCKET": where, "HOME": "/"}
        manager = ServiceManager.of(environment)
        assert environment == {"HOME": "/"}  # nobody below speaks for the service
        manager.ready()
        manager.alive()
        manager.status("companion died (SIGKILL), restarting")
        assert [systemd.recv(100) for _ in range(3)] == [
            b"READY=1", b"WATCHDOG=1", b"STATUS=companion died (SIGKILL), restarting",
        ]  # fmt: skip
    manager.alive()  # a socket that is gone, or was never there, costs nothing
    manager.close()
    manager.alive()
    ServiceManager.of({}).ready()


def test_the_unit_lets_a_watched_service_start_and_hang_no_longer_than_it_may() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(Path(__file__).parents[3] / "configs" / "companion.service")
    service = unit["Service"]
    assert service["Type"] == "notify"
    assert "--supervised" in service["ExecStart"]  # who tells systemd
    policy = RestartPolicy()
    # What ends a hung process may wait 10 s for its end, and tells within a second.
    assert float(service["WatchdogSec"]) > max(policy.part_s, policy.silent_s) + 10.0 + 1.0
    assert service["TimeoutStartSec"] == "infinity"


# --- The supervisor's signs of life: the part that is longest without a turn --------------------


def test_the_oldest_turn_is_told() -> None:
    now_ns = 100_000_000_000
    last_ticks_ns = {
        "render": now_ns - 5_000_000,
        "link fc": now_ns - 7_100_000_000,
        "feed": now_ns + 9,
    }
    assert line(last_ticks_ns, now_ns) == b"link-fc 7100\n"
    assert line({}, now_ns) == b"all 0\n"


def test_a_pulse_is_read_and_a_supervisor_that_does_not_read_is_not_waited_for() -> None:
    reading, writing = os.pipe()
    beating = threading.Event()

    def last_ticks_ns() -> dict[str, int]:
        beating.set()
        return {}

    while True:  # until the pipe is full
        os.set_blocking(writing, False)
        try:
            os.write(writing, b"x" * 4096)
        except BlockingIOError:
            break
    pulse = Pulse(last_ticks_ns, writing)
    pulse.start()
    assert beating.wait(20.0)
    pulse.stop(clean_shutdown=True)
    os.close(reading)


@pytest.mark.parametrize("clean_shutdown", [True, False])
def test_the_last_word_says_whether_the_end_is_in_order(clean_shutdown: bool) -> None:
    reading, writing = os.pipe()
    pulse = Pulse(lambda: {}, writing)
    pulse.start()
    pulse.stop(clean_shutdown=clean_shutdown)
    last = os.read(reading, 4096).splitlines()[-1]
    os.close(reading)
    assert last == (f"{ENDING} 0" if clean_shutdown else "failing 0").encode()


def test_a_frame_that_a_part_keeps_is_seen() -> None:
    """The feed waits for the camera as long as it likes, and for no part."""
    taken, go = threading.Event(), threading.Event()

    class Source:
        def frames(self):  # type: ignore[no-untyped-def]
            yield object()

        def close(self) -> None:
            pass

    def keeps(_: object) -> None:
        taken.set()
        go.wait(20.0)

    feed = Feed(Source(), keeps)  # type: ignore[arg-type]
    feed.start()
    assert taken.wait(20.0)
    assert feed.last_tick_ns == feed.last_tick_ns
    go.set()
    feed.stop()
    assert feed.last_tick_ns < feed.last_tick_ns


def test_what_is_no_beat_is_no_sign_of_life() -> None:
    """The pipe is the process's own; a library that writes into it must not end the supervisor."""
    script = (
        "import os, sys; os.write(int(sys.argv[1][8:]), b'a 1\\nnonsense\\nb x\\nc 2500\\nd 1')"
    )
    process = FlightProcess([sys.executable, "-S", "-c", script], standby=False)
    assert process.wait(20.0) == 0
    assert process.beats() == (Beat("a", 0.001), Beat("c", 2.5))
    assert process.beats() == ()
    process.close()
    process.close()


def test_a_part_that_was_made_long_before_the_start_is_no_hang() -> None:
    """A slow computer compiles for half a minute between: the process was ended at its first beat,
    "hangs (health)", and would have been each time.
    """
    reading, writing = os.pipe()
    made_ns = time.monotonic_ns() - 60_000_000_000
    pulse = Pulse(lambda: {"health": made_ns, "feed": time.monotonic_ns()}, writing)
    pulse.start()
    first = os.read(reading, 100).split(b"\n")[0]
    pulse.stop(clean_shutdown=True)
    os.close(reading)
    name, age_ms = first.split()
    assert name == b"health"
    assert int(age_ms) < 30_000  # since the start, whatever the machine does meanwhile


# --- restart ------------------------------------------------------------------------------------


MODEL = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
CAMERA = {"model": MODEL, "source": "udp://x:1"}


def deployment(stick: Path, **bridge: str) -> CompanionConfig:
    data = {
        "map": "map", "camera": CAMERA, "bridge": bridge,
        "record": {"folder": str(stick / "flight")},
    }  # fmt: skip
    return parse_config(data, "here")


def test_what_can_be_written_stays_as_it_is(tmp_path: Path) -> None:
    config = deployment(tmp_path / "new", tlog=str(tmp_path / "logs" / "a.tlog"))
    assert without_lost_disks(config) == (config, "")
    assert not list((tmp_path / "new").iterdir())


def test_a_stick_that_is_gone_costs_the_record_and_not_the_flight(tmp_path: Path) -> None:
    """Its mount point is a folder of root's again, or is no more: no disk fault, and each restart
    ended with a wrong setting.
    """
    stick = tmp_path / "stick"
    stick.write_text("no folder any more")
    left, told = without_lost_disks(deployment(stick, tlog=str(stick / "a.tlog")))
    assert left.record is None
    assert left.bridge.tlog is None
    assert str(stick) in told
    # They are only read and written where that goes, and keep their names.
    assert left.state_folder == stick


def test_one_disk_of_two(tmp_path: Path) -> None:
    stick = tmp_path / "stick"
    stick.write_text("")
    left, told = without_lost_disks(deployment(tmp_path, tlog=str(stick / "a.tlog")))
    assert left.record is not None
    assert left.bridge.tlog is None
    assert told == f"{stick}: Not a directory" or str(stick) in told


def test_a_log_that_is_there_is_appended_to(tmp_path: Path) -> None:
    (tmp_path / "a.tlog").touch()
    config = deployment(tmp_path, tlog=str(tmp_path / "a.tlog"))
    left, told = without_lost_disks(config, lambda _: "Permission denied")
    assert left.bridge.tlog == tmp_path / "a.tlog"
    assert left.record is None
    assert told == f"{tmp_path}: Permission denied"


def test_a_disk_that_stands_still_is_not_even_read(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.supervision.processes._PATIENCE_S", 0.05)
    still = threading.Event()

    def probe(folder: Path) -> str:
        if folder == tmp_path / "stick":
            still.wait(120.0)
        return ""

    config = deployment(tmp_path / "stick", tlog=str(tmp_path / "a.tlog"))
    left, told = without_lost_disks(config, probe)
    still.set()
    assert told == f"{tmp_path / 'stick'}: does not answer"
    assert left.record is None
    assert left.bridge.tlog == tmp_path / "a.tlog"
    assert left.state_folder is None


@pytest.mark.parametrize(
    ("number", "told"), [(errno.ENOSPC, False), (errno.EUCLEAN, False), (errno.EACCES, True)]
)
def test_a_full_or_failing_disk_is_the_recorders_to_tell(tmp_path, monkeypatch, number, told):
    def full(*_: object, **__: object) -> None:
        raise OSError(number, "as it is")

    monkeypatch.setattr("tempfile.mkstemp", full)
    assert bool(write_problem(tmp_path)) is told
