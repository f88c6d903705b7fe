"""What the health monitor makes of its parts, and that a bad disk does not silence it."""

import json
import threading
import time
from pathlib import Path
from types import SimpleNamespace

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
STARTING, OK = HealthLevel.STARTING, HealthLevel.OK
DEGRADED, FAILED = HealthLevel.DEGRADED, HealthLevel.FAILED


class FakeBridge:
    def __init__(self, connected=True, injection_fault=None):
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


def _estimate(state=TrackingState.TRACKING, **said):
    return SimpleNamespace(state=state, stage_ms={}, sequence=0, **{"last_fix_ns": None, **said})


def _monitor(folder, bridge=None, *, feed=StreamState.LIVE, engine=None, events=None, **inputs):
    return HealthMonitor(
        lambda: engine or EngineHealth(), bridge or FakeBridge(), lambda: feed,
        lambda *event: None if events is None else events.append(event), folder,
        HealthInputs(**inputs),
    )  # fmt: skip


def _one_report(monitor, *estimates):
    """Of a monitor that is started and stopped."""
    for estimate in estimates:
        monitor.add_estimate(estimate)
    monitor.start()
    monitor.stop()


@pytest.fixture(autouse=True)
def no_estimate_is_stale(monkeypatch):
    """However long a busy machine takes from adding it to reporting it."""
    monkeypatch.setattr("companion.flight.health._STALE_S", 600.0)


def _engine(**said):
    return {"engine": EngineHealth(frames_in=3, **said)}


def _lacks(of):
    return {"search_lacks": lambda: of}


NO_MAP = _engine(last_error="x", no_map_in_view=True)
HANGS = {"engine": EngineHealth(search_hangs=True)}
UNREADABLE = {"unreadable_nodes": lambda: 3}
HELD = SimpleNamespace(reason=FROZEN, level=None, active_values=dict)
TRACKED, LOST = _estimate(), _estimate(TrackingState.LOST)


def _bridged(seconds):
    return _estimate(
        TrackingState.BRIDGING, exposure_time_ns=100 * 10**9,
        last_fix_ns=(100 - seconds) * 10**9, covariance=np.eye(6) * 4.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("estimate", "given", "told"),
    [
        (None, {}, (STARTING, AlertId.WAITING_FOR_VIDEO)),
        (None, {"feed": StreamState.STALLED}, (DEGRADED, AlertId.VIDEO_STALLED)),
        (None, {"feed": StreamState.FAILED}, (FAILED, AlertId.VIDEO_FAILED)),
        (None, {"feed": StreamState.MISFIT}, (FAILED, AlertId.VIDEO_SIZE)),
        # With pictures and no estimate the autopilot's position or attitude is missing.
        (None, _engine(), (STARTING, AlertId.WAITING_FOR_PRIOR)),
        (None, _engine(searches=2, searching=True), (STARTING, AlertId.SEARCHING)),
        (None, _engine(searches=2), (STARTING, AlertId.SEARCHING)),  # between two searches
        (None, _engine(last_error="x"), (STARTING, AlertId.LOCALIZATION_FAILED)),
        (None, NO_MAP, (STARTING, AlertId.NO_MAP_IN_VIEW)),
        # A disk that fails empties the view: `no map in view` alone is also that of each take-off.
        (None, NO_MAP | UNREADABLE, (STARTING, AlertId.NO_MAP_IN_VIEW, AlertId.MAP_UNREADABLE)),
        # The heartbeat says CRITICAL: nobody has a position of ours.
        (TRACKED, {"integrity_monitor": HELD}, (FAILED, FROZEN.id)),
        (TRACKED, {"feed": StreamState.SCALED}, (OK, AlertId.TRACKING, AlertId.VIDEO_SCALED)),
        (TRACKED, {"is_recorded": lambda: False},
         (OK, AlertId.TRACKING, AlertId.RECORD_INCOMPLETE)),
        # That a loss cannot be searched is told before it comes,
        (TRACKED, HANGS, (DEGRADED, AlertId.SEARCH_HANGS)),
        (LOST, HANGS, (FAILED, AlertId.LOST, AlertId.SEARCH_HANGS)),
        (TRACKED, _lacks(AlertId.NO_SEARCH), (DEGRADED, AlertId.NO_SEARCH)),
        (LOST, _lacks(AlertId.NO_SEARCH), (FAILED, AlertId.LOST, AlertId.NO_SEARCH)),
        # but what passes (at a map's first start, after minutes) is no news for who is not lost.
        (TRACKED, _lacks(AlertId.SEARCH_NOT_READY), (OK, AlertId.TRACKING)),
        (LOST, _lacks(AlertId.SEARCH_NOT_READY), (FAILED, AlertId.LOST, AlertId.SEARCH_NOT_READY)),
        (TRACKED, _lacks(AlertId.WAITING_FOR_PRIOR), (OK, AlertId.TRACKING)),
        (LOST, {}, (FAILED, AlertId.LOST)),
        # Bridging is told once it lasts.
        (_bridged(1), {}, (OK, AlertId.TRACKING)),
        (_bridged(23), {}, (DEGRADED, AlertId.BRIDGING)),
    ],
)  # fmt: skip
def test_the_worst_thing_is_told_with_what_is_true_beside_it(tmp_path, estimate, given, told):
    bridge, events = FakeBridge(), list[tuple[str, str]]()
    monitor = _monitor(tmp_path, bridge, events=events, **given)
    _one_report(monitor, *([] if estimate is None else [estimate]))
    assert bridge.told[-1] == told
    assert events == []  # the bridge logs and records it; once is enough


@pytest.mark.parametrize(
    ("bridge", "estimate", "told"),
    [
        # Found on ArduPilot: the yaw guard refused every fix, LAND without a position, health ok.
        (FakeBridge(injection_fault=FAULT), TRACKED, (DEGRADED, FAULT.id)),
        (FakeBridge(injection_fault=FAULT), LOST, (FAILED, AlertId.LOST)),  # the worse news
        (FakeBridge(connected=False), TRACKED, (DEGRADED, AlertId.FC_SILENT)),
    ],
)
def test_tracking_that_the_ekf_does_not_get_is_not_ok(tmp_path, bridge, estimate, told):
    _one_report(_monitor(tmp_path, bridge), estimate)
    assert bridge.told[-1] == told


def test_a_map_that_cannot_be_read_is_told_after_the_last_fix(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.flight.health._STALE_S", -1.0)
    bridge = FakeBridge()
    _one_report(_monitor(tmp_path, bridge, **NO_MAP, **UNREADABLE), TRACKED)
    assert bridge.told[-1] == (DEGRADED, AlertId.NO_MAP_IN_VIEW, AlertId.MAP_UNREADABLE)


def test_the_file_has_the_report_as_json(tmp_path):
    _one_report(_monitor(tmp_path, feed=StreamState.STALLED))
    written = json.loads((tmp_path / "health.json").read_text())
    assert set(written) == {
        "level", "text", "alerts", "time_ns",
        "pid", "engine", "rate_hz", "stages_ms", "bridge", "shadow",
        "guardian", "map_shift", "targets",
    }  # fmt: skip
    assert written["bridge"]["fix_latency_ms"] is None  # NaN is no JSON
    assert written["level"] == "degraded"
    assert time.monotonic_ns() - written["time_ns"] < 60e9


def test_a_file_that_cannot_be_written_is_an_event_and_the_bridge_is_still_told(tmp_path):
    bridge, events = FakeBridge(), list[tuple[str, str]]()
    _one_report(_monitor(tmp_path / "gone", bridge, events=events))
    assert bridge.told
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
    bridge = FakeBridge()
    monitor = _monitor(tmp_path, bridge)
    monitor.start()
    assert stands.wait(30.0)
    told, last_tick_ns = len(bridge.told), monitor.last_tick_ns
    assert sleep_until(lambda: len(bridge.told) >= told + 3, 30.0)
    assert monitor.last_tick_ns > last_tick_ns
    goes_on.set()
    monitor.stop()


def test_a_report_that_fails_is_not_the_last(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("companion.flight.health._PERIOD_S", 0.05)
    failures = iter([RuntimeError("boom"), RuntimeError("boom")])

    def is_recorded():
        for error in failures:
            raise error
        return True

    bridge = FakeBridge()
    monitor = _monitor(tmp_path, bridge, is_recorded=is_recorded)
    monitor.start()
    assert sleep_until(lambda: bool(bridge.told), 30.0)
    monitor.stop()
    assert sum("could not be reported" in r.message for r in caplog.records) == 1


def test_a_loss_says_how_long_and_how_far_and_is_no_news_when_a_search_ends(tmp_path):
    lost = _estimate(TrackingState.LOST, last_fix_ns=time.monotonic_ns() - 23 * 10**9)
    seen = set()
    for searching in (True, False):
        bridge = FakeBridge()
        engine = EngineHealth(frames_in=9, searching=searching)
        _one_report(_monitor(None, bridge, engine=engine, position_sigma_m=lambda: 20.0), lost)
        assert bridge.alerts[0] == alert(AlertId.LOST, seconds=pytest.approx(23.0, abs=5.0))
        assert bridge.alerts[1] == alert(AlertId.EKF_UNCERTAIN, metres=40.0)
        seen.add(bridge.told[-1])
    assert len(seen) == 1


def test_after_the_end_the_file_says_that_it_ended_and_how(tmp_path):
    bridge = FakeBridge()
    monitor = _monitor(tmp_path, bridge, **UNREADABLE)
    monitor.add_estimate(TRACKED)
    monitor.start()
    monitor.end("stopped")
    monitor.stop()
    report = json.loads((tmp_path / "health.json").read_text())
    assert report["level"] == "ended"
    assert report["text"] == "stopped; localization tracking, map unreadable until then"
    assert bridge.said == [alert(AlertId.ENDING)]


@pytest.fixture
def clock(monkeypatch):
    """Seconds that the test moves."""
    now = [100.0]
    monkeypatch.setattr("companion.flight.health._STALE_S", 2.0)
    monkeypatch.setattr("companion.flight.health.time.monotonic", lambda: now[0])
    return now


def test_a_camera_that_ended_before_does_not_speak_for_the_flight(tmp_path, clock):
    monitor = _monitor(tmp_path)
    monitor.add_estimate(TRACKED)
    clock[0] += 5.0
    monitor.end("stopped")
    _one_report(monitor)
    assert json.loads((tmp_path / "health.json").read_text())["text"] == (
        "stopped; localization tracking until 5 s before, then no frame is being localized"
    )


def test_an_overloaded_computer_is_told_as_that(clock):
    """Ten pictures a second come, one is localized; with five a second all is well."""
    came = [0]
    monitor = HealthMonitor(
        lambda: EngineHealth(frames_in=came[0]), FakeBridge(), lambda: StreamState.LIVE,
        lambda *_: None, None,
    )  # fmt: skip

    def fly(seconds, localized_hz):
        for _ in range(seconds):
            clock[0] += 1.0
            came[0] += 10
            for _ in range(localized_hz):
                monitor.add_estimate(TRACKED)
            yield monitor.assess().alerts

    assert {alerts[0].id for alerts in fly(10, 5)} == {AlertId.TRACKING}
    assert [*fly(8, 1)][-1][0].id is AlertId.OVERLOADED
    assert [*fly(8, 5)][-1] == (alert(AlertId.TRACKING),)
    # A hang, which was told as an overload.
    assert [alerts[0].id for alerts in fly(8, 0)][2:] == [AlertId.NO_FRAME] * 6


def test_its_first_turn_is_its_start_not_its_making():
    """Kernels are compiled for a minute between the two: it was told to stand before it began."""
    monitor = _monitor(None)
    made_ns = monitor.last_tick_ns = monitor.last_tick_ns - 36_000_000_000
    monitor.start()
    begun_ns = monitor.last_tick_ns
    monitor.stop()
    assert begun_ns - made_ns >= 36_000_000_000


def test_a_video_that_fails_is_told_before_the_end(tmp_path):
    """It ends the flight at once: the next second's report had only the end."""
    bridge = FakeBridge()
    monitor = _monitor(tmp_path, bridge, feed=StreamState.CLOSED)
    monitor.start()
    monitor.end("the feed ended: damaged", is_failure=True)
    monitor.stop()
    assert bridge.told == [(FAILED, AlertId.VIDEO_FAILED)]
    assert [alert.id for alert in bridge.said] == [AlertId.ENDING]
