"""What the health monitor makes of its parts, and that a bad disk does not silence it."""

import json
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.flight.health import HealthInputs, HealthMonitor
from companion.sources import StreamState
from localizer.tracking.engine_health import EngineHealth
from localizer.types import TrackingState
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.messages import HealthLevel

FROZEN = alert(AlertId.VIDEO_FROZEN, seconds=4.0)
FAULT = alert(AlertId.YAW_MISMATCH, degrees=8.7)


class FakeBridge:
    def __init__(self, connected, injection_fault=None):
        self._connected = connected
        self.injection_fault = injection_fault
        self.told = []
        self.said = []

    def report_alert(self, alert):
        self.said.append(alert)

    def state(self):
        return SimpleNamespace(connected=self._connected)

    def set_health(self, level, alerts, *, tell=True):
        known = {alert.id for alert in alerts} & {FAULT.id, FROZEN.id}  # told by bridge and monitor
        assert tell is (self._connected and not known)  # as is a silent vehicle
        self.told.append((level, *(alert.id for alert in alerts)))
        self.alerts = alerts

    def counters(self):
        return {"fix_latency_ms": float("nan")}

    def shadow_score(self):
        return SimpleNamespace(ready=False, line=lambda: "no comparison yet")


def _one_report(
    folder, state, connected, tracking=None, injection_fault=None, engine=None, **options
):
    """What the bridge is told, and the events, of a monitor that is started and stopped."""
    bridge, events = FakeBridge(connected, injection_fault), []
    monitor = HealthMonitor(
        lambda: engine or EngineHealth(), bridge, lambda: state,
        lambda *e: events.append(e), folder, HealthInputs(**options),
    )  # fmt: skip
    if tracking is not None:
        monitor.add_estimate(SimpleNamespace(state=tracking, stage_ms={}, last_fix_ns=None))
    monitor.start()
    monitor.stop()
    return bridge.told, events


@pytest.fixture(autouse=True)
def no_estimate_is_stale(monkeypatch):
    """However long a busy machine takes from adding it to reporting it."""
    monkeypatch.setattr("companion.flight.health._STALE_S", 600.0)


@pytest.mark.parametrize(
    ("state", "connected", "level", "of"),
    [
        (StreamState.LIVE, True, HealthLevel.STARTING, AlertId.WAITING_FOR_VIDEO),
        (StreamState.LIVE, False, HealthLevel.DEGRADED, AlertId.FC_SILENT),
        (StreamState.STALLED, True, HealthLevel.DEGRADED, AlertId.VIDEO_STALLED),
        (StreamState.FAILED, True, HealthLevel.FAILED, AlertId.VIDEO_FAILED),
        (StreamState.MISFIT, True, HealthLevel.FAILED, AlertId.VIDEO_SIZE),
    ],
)
def test_the_worst_thing_is_told(tmp_path, state, connected, level, of):
    told, events = _one_report(tmp_path, state, connected)
    assert told[-1] == (level, of)
    assert events == []  # the bridge logs and records it; once is enough
    written = json.loads((tmp_path / "health.json").read_text())
    assert set(written) == {
        "level", "text", "alerts", "time_ns",
        "pid", "engine", "rate_hz", "stages_ms", "bridge", "shadow",
        "guardian", "map_shift", "targets",
    }  # fmt: skip
    assert written["bridge"]["fix_latency_ms"] is None  # NaN is no JSON
    assert written["level"] == level.value
    assert time.monotonic_ns() - written["time_ns"] < 60e9


@pytest.mark.parametrize(
    ("engine", "of"),
    [
        (EngineHealth(frames_in=3), AlertId.WAITING_FOR_PRIOR),
        (EngineHealth(frames_in=3, searches=2, searching=True), AlertId.SEARCHING),
        (EngineHealth(frames_in=3, searches=2), AlertId.SEARCHING),  # between two searches
        (EngineHealth(frames_in=3, last_error="x"), AlertId.LOCALIZATION_FAILED),
        (EngineHealth(frames_in=3, last_error="x", no_map_in_view=True), AlertId.NO_MAP_IN_VIEW),
    ],
)
def test_what_is_waited_for_is_told(tmp_path, engine, of):
    """With pictures and no estimate it is the autopilot's position or attitude that is missing."""
    told, _ = _one_report(tmp_path, StreamState.LIVE, True, engine=engine)
    assert told[-1] == (HealthLevel.STARTING, of)


def test_a_map_that_cannot_be_read_is_reported_before_the_first_fix_and_after_the_last(
    tmp_path, monkeypatch
):
    """A disk that fails empties the view: `no map in view` alone is also that of each take-off."""
    engine = EngineHealth(frames_in=3, last_error="x", no_map_in_view=True)
    expected = (AlertId.NO_MAP_IN_VIEW, AlertId.MAP_UNREADABLE)
    options: dict[str, Any] = {"engine": engine, "unreadable_nodes": lambda: 3}
    told, _ = _one_report(tmp_path, StreamState.LIVE, True, **options)
    assert told[-1] == (HealthLevel.STARTING, *expected)
    monkeypatch.setattr("companion.flight.health._STALE_S", -1.0)
    told, _ = _one_report(tmp_path, StreamState.LIVE, True, TrackingState.TRACKING, **options)
    assert told[-1] == (HealthLevel.DEGRADED, *expected)


def test_tracking_that_the_ekf_does_not_get_is_not_ok(tmp_path):
    """Found on ArduPilot: the yaw guard refused every fix, LAND without a position, health ok."""
    told, _ = _one_report(
        tmp_path, StreamState.LIVE, True, tracking=TrackingState.TRACKING, injection_fault=FAULT
    )
    assert told[-1] == (HealthLevel.DEGRADED, FAULT.id)
    lost, _ = _one_report(
        tmp_path, StreamState.LIVE, True, tracking=TrackingState.LOST, injection_fault=FAULT
    )
    assert lost[-1][0] is HealthLevel.FAILED  # the worse news


def test_tracking_that_the_guardian_withholds_is_a_failure(tmp_path):
    """The heartbeat says CRITICAL: nobody has a position of ours."""
    integrity_monitor = SimpleNamespace(reason=FROZEN, level=None, standing=list)
    told, _ = _one_report(
        tmp_path,
        StreamState.LIVE,
        True,
        tracking=TrackingState.TRACKING,
        integrity_monitor=integrity_monitor,
    )
    assert told[-1] == (HealthLevel.FAILED, FROZEN.id)


def test_scaled_video_is_told_beside_what_localization_makes_of_it(tmp_path):
    told, _ = _one_report(tmp_path, StreamState.SCALED, True, TrackingState.TRACKING)
    assert told[-1] == (HealthLevel.OK, AlertId.TRACKING, AlertId.VIDEO_SCALED)


def test_a_file_that_cannot_be_written_is_an_event_and_the_bridge_is_still_told(tmp_path):
    told, events = _one_report(tmp_path / "gone", StreamState.LIVE, True)
    assert told
    assert any("cannot be written" in text for _, text in events)


def test_a_disk_that_stands_still_keeps_the_health_from_nobody(tmp_path, monkeypatch):
    """Its thread stood, too: the last level was told for ever, and after 4 s the supervisor ended
    the process as one that hangs.
    """
    monkeypatch.setattr("companion.flight.health._PERIOD_S", 0.02)
    stands, goes_on = threading.Event(), threading.Event()

    def replace(*_):
        stands.set()
        goes_on.wait(60.0)

    monkeypatch.setattr(Path, "replace", replace)
    bridge = FakeBridge(True)
    monitor = HealthMonitor(
        EngineHealth, bridge, lambda: StreamState.LIVE, lambda *_: None, tmp_path
    )
    monitor.start()
    assert stands.wait(30.0)
    told, last_tick_ns = len(bridge.told), monitor.last_tick_ns
    assert sleep_until(lambda: len(bridge.told) >= told + 3, 30.0)
    assert monitor.last_tick_ns > last_tick_ns
    goes_on.set()
    monitor.stop()


def test_a_record_that_fails_is_told_as_long_as_it_does(tmp_path):
    told, _ = _one_report(
        tmp_path, StreamState.LIVE, True, TrackingState.TRACKING, is_recorded=lambda: False
    )
    assert told[-1] == (HealthLevel.OK, AlertId.TRACKING, AlertId.RECORD_INCOMPLETE)


def test_a_report_that_fails_is_not_the_last(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("companion.flight.health._PERIOD_S", 0.05)
    states = iter([RuntimeError("boom"), RuntimeError("boom")])

    def state():
        error = next(states, None)
        if error is not None:
            raise error
        return StreamState.LIVE

    bridge = FakeBridge(True)
    monitor = HealthMonitor(EngineHealth, bridge, state, lambda *_: None, tmp_path)
    monitor.start()
    assert sleep_until(lambda: bool(bridge.told), 30.0)
    monitor.stop()
    assert sum("could not be reported" in r.message for r in caplog.records) == 1


def test_a_loss_says_how_long_and_how_far_and_is_no_news_when_a_search_ends(tmp_path):
    lost = SimpleNamespace(
        state=TrackingState.LOST, stage_ms={}, last_fix_ns=time.monotonic_ns() - 23 * 10**9
    )
    seen = set()
    for searching, hangs in ((True, False), (False, False), (True, True)):
        bridge = FakeBridge(True)
        monitor = HealthMonitor(
            partial(EngineHealth, frames_in=9, searching=searching, search_hangs=hangs), bridge,
            lambda: StreamState.LIVE, lambda *_: None, tmp_path,
            HealthInputs(position_sigma_m=lambda: 20.0),
        )  # fmt: skip
        monitor.add_estimate(lost)
        monitor.start()
        monitor.stop()
        level, *ids = bridge.told[-1]
        assert level is HealthLevel.FAILED
        assert bridge.alerts[0] == alert(AlertId.LOST, seconds=pytest.approx(23.0, abs=5.0))
        assert bridge.alerts[1] == alert(AlertId.EKF_UNCERTAIN, metres=40.0)
        assert (AlertId.SEARCH_HANGS in ids) is hangs
        seen.add(tuple(ids))
    assert len(seen) == 2  # a search that will not answer is


@pytest.mark.parametrize(
    ("hangs", "lacks", "tracking", "lost"),
    [
        (True, None, AlertId.SEARCH_HANGS, AlertId.SEARCH_HANGS),
        (False, AlertId.NO_SEARCH, AlertId.NO_SEARCH, AlertId.NO_SEARCH),
        # At a map's first start, for minutes: no news for who is not lost.
        (False, AlertId.SEARCH_NOT_READY, AlertId.TRACKING, AlertId.SEARCH_NOT_READY),
        (False, AlertId.WAITING_FOR_PRIOR, AlertId.TRACKING, AlertId.WAITING_FOR_PRIOR),
        (False, None, AlertId.TRACKING, AlertId.LOST),
    ],
)
def test_that_a_loss_cannot_be_searched_is_told_before_it_comes(
    tmp_path, hangs, lacks, tracking, lost
):
    for state, of in ((TrackingState.TRACKING, tracking), (TrackingState.LOST, lost)):
        bridge = FakeBridge(True)
        monitor = HealthMonitor(
            partial(EngineHealth, search_hangs=hangs), bridge, lambda: StreamState.LIVE,
            lambda *_: None, tmp_path, HealthInputs(search_lacks=lambda: lacks),
        )  # fmt: skip
        monitor.add_estimate(SimpleNamespace(state=state, stage_ms={}, last_fix_ns=None))
        monitor.start()
        monitor.stop()
        assert bridge.told[-1][-1] is of


def test_after_the_end_the_file_says_that_it_ended_and_how(tmp_path):
    bridge = FakeBridge(True)
    monitor = HealthMonitor(
        lambda: EngineHealth(frames_in=9), bridge, lambda: StreamState.LIVE, lambda *_: None,
        tmp_path, HealthInputs(unreadable_nodes=lambda: 3),
    )  # fmt: skip
    tracking = SimpleNamespace(state=TrackingState.TRACKING, stage_ms={}, last_fix_ns=None)
    monitor.add_estimate(tracking)
    monitor.start()
    monitor.end("stopped")
    monitor.stop()
    report = json.loads((tmp_path / "health.json").read_text())
    assert report["level"] == "ended"
    assert report["text"] == "stopped; localization tracking, map unreadable until then"
    assert bridge.said == [alert(AlertId.ENDING)]


def test_a_camera_that_ended_before_does_not_speak_for_the_flight(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("companion.flight.health._STALE_S", 2.0)
    monkeypatch.setattr("companion.flight.health.time.monotonic", lambda: now[0])
    monitor = HealthMonitor(
        EngineHealth, FakeBridge(True), lambda: StreamState.LIVE, lambda *_: None, tmp_path
    )
    tracking = SimpleNamespace(state=TrackingState.TRACKING, stage_ms={}, last_fix_ns=None)
    monitor.add_estimate(tracking)
    now[0] += 5.0
    monitor.end("stopped")
    monitor.start()
    monitor.stop()
    assert json.loads((tmp_path / "health.json").read_text())["text"] == (
        "stopped; localization tracking until 5 s before, then no frame is being localized"
    )


@pytest.mark.parametrize(
    ("seconds", "level", "of"),
    [(1, HealthLevel.OK, AlertId.TRACKING), (23, HealthLevel.DEGRADED, AlertId.BRIDGING)],
)
def test_bridging_is_told_once_it_lasts(tmp_path, seconds, level, of):
    bridged = SimpleNamespace(
        state=TrackingState.BRIDGING, stage_ms={}, exposure_time_ns=100 * 10**9,
        last_fix_ns=(100 - seconds) * 10**9, covariance=np.eye(6) * 4.0,
    )  # fmt: skip
    bridge = FakeBridge(True)
    monitor = HealthMonitor(
        lambda: EngineHealth(frames_in=9),
        bridge,
        lambda: StreamState.LIVE,
        lambda *_: None,
        tmp_path,
    )
    monitor.add_estimate(bridged)
    monitor.start()
    monitor.stop()
    assert bridge.told[0] == (level, of)


def test_an_overloaded_computer_is_told_as_that(tmp_path, monkeypatch):
    """Ten pictures a second come, one is localized; with five a second all is well."""
    now, came = [100.0], [0]
    monkeypatch.setattr("companion.flight.health._STALE_S", 2.0)
    monkeypatch.setattr("companion.flight.health.time.monotonic", lambda: now[0])
    bridge = FakeBridge(True)
    monitor = HealthMonitor(
        lambda: EngineHealth(frames_in=came[0]), bridge, lambda: StreamState.LIVE,
        lambda *_: None, tmp_path,
    )  # fmt: skip

    def fly(seconds, localized_hz):
        for _ in range(seconds):
            now[0] += 1.0
            came[0] += 10
            for _ in range(localized_hz):
                monitor.add_estimate(
                    SimpleNamespace(
                        state=TrackingState.TRACKING, stage_ms={}, last_fix_ns=None, sequence=0
                    )
                )
            told.append(monitor.assess())

    told: list[Any] = []
    fly(10, 5)
    assert {status.alerts[0].id for status in told} == {AlertId.TRACKING}
    told.clear()
    fly(8, 1)
    assert told[-1].alerts[0].id is AlertId.OVERLOADED
    fly(8, 5)
    assert told[-1].alerts == (alert(AlertId.TRACKING),)
    told.clear()
    fly(8, 0)  # a hang, which was told as an overload
    assert [status.alerts[0].id for status in told[2:]] == [AlertId.NO_FRAME] * 6


def test_its_first_turn_is_its_start_not_its_making():
    """Kernels are compiled for a minute between the two: it was told to stand before it began."""
    state, connected = StreamState.LIVE, True
    monitor = HealthMonitor(
        EngineHealth, FakeBridge(connected), lambda: state, lambda *_: None, None
    )
    made_ns = monitor.last_tick_ns = monitor.last_tick_ns - 36_000_000_000
    monitor.start()
    begun_ns = monitor.last_tick_ns
    monitor.stop()
    assert begun_ns - made_ns >= 36_000_000_000


def test_a_video_that_fails_is_told_before_the_end(tmp_path):
    """It ends the flight at once: the next second's report had only the end."""
    bridge = FakeBridge(True)
    monitor = HealthMonitor(
        EngineHealth, bridge, lambda: StreamState.CLOSED, lambda *_: None, tmp_path
    )
    monitor.start()
    monitor.end("the feed ended: damaged", is_failure=True)
    monitor.stop()
    assert bridge.told == [(HealthLevel.FAILED, AlertId.VIDEO_FAILED)]
    assert [alert.id for alert in bridge.said] == [AlertId.ENDING]
