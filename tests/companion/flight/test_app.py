"""The whole process, wired: an embedded vehicle, a feed of grey pictures, a record."""

import contextlib
import csv
import errno
import itertools
import logging
import os
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from companion.config import parse_config
from companion.errors import ConfigError, ReportError, StreamOpenError
from companion.flight.app import Companion
from companion.flight.channels import Feed
from companion.flight.component_table import COMPONENTS
from companion.flight.components import Component
from companion.flight.health import HealthMonitor
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.link.link import sleep_until
from sitl.geodesy import Location
from sitl.vehicles.launch import GIMBAL, EmbeddedSitl, vision_parameters

HOME = Location(47.397742, 8.545594, 488.0)
MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}
MAP = next(p for p in COMPONENTS if p.name == "map")


@pytest.fixture
def deployed(small_assets):
    """A deployment over the small map, with these settings of the camera and of other sections."""

    def deployment(source="s", *, settings=None, bridge=None, **sections):
        camera = {"source": str(source), "model": MODEL, "settings": settings or {}}
        bridge = {"connection": "tcp:127.0.0.1:9"} | (bridge or {})
        given = {"map": str(small_assets.map_cache), "camera": camera, "bridge": bridge}
        return parse_config(given | sections, "test")

    return deployment


def test_an_origin_far_from_the_map_is_never_sent(deployed):
    """0, 0 or a wrong digit: the vehicle would keep it until it is switched off."""
    origin = {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_amsl_m": 0.0}
    with pytest.raises(ConfigError, match=r"bridge\.origin: \d+\.\d km beside"):
        Companion(deployed(bridge={"origin": origin})).run()


def test_a_restart_on_a_full_disk_goes_on_without_a_record(deployed, tmp_path, monkeypatch, caplog):
    """In the air a position is worth more than a record. The feed's error ends the start here."""
    config = deployed(
        tmp_path / "no.mp4", bridge={"tlog": str(tmp_path / "a" / "a.tlog")},
        record={"folder": str(tmp_path / "record")},
    )  # fmt: skip

    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(StreamOpenError):
        Companion(config).run()
    assert any("record is incomplete: [Errno 28]" in r.getMessage() for r in caplog.records)


def test_a_restart_whose_stick_is_gone_goes_on_without_a_record(deployed, tmp_path):
    """A first start names the setting; in the air it was right when the flight began."""
    (tmp_path / "stick").touch()
    config = deployed(tmp_path / "no.mp4", record={"folder": str(tmp_path / "stick" / "record")})
    with pytest.raises(ReportError, match=r"record\.folder .*cannot be written"):
        Companion(config).run()
    with pytest.raises(StreamOpenError):
        Companion(config, restart=True).run()


class _InterruptedWait:
    """A feed's `ended` whose `wait`, as an Event's, holds its lock when a signal interrupts it."""

    def __init__(self):
        self.interrupt = lambda: None
        self._lock = threading.Lock()

    def wait(self, timeout):
        with self._lock:
            self.interrupt()
        return False

    def set(self):
        assert self._lock.acquire(timeout=0), "would wait for ever"


class _StubFeed(Feed):
    ended: Any

    def __init__(self):
        self.ended, self.error = _InterruptedWait(), None


def test_the_order_to_stop_takes_no_lock(deployed):
    """It comes from a signal handler, which may interrupt the very lines that hold the lock."""
    feed, orders = _StubFeed(), []
    companion = Companion(deployed(), [MAP, Component("feed", Feed, lambda _: feed)])
    feed.ended.interrupt = lambda: orders.append(companion.stop())
    companion.run()
    assert orders == [True]


@pytest.mark.parametrize("lost", ["", "companion.yaml: cannot be read: Input/output error"])
def test_a_restart_without_its_deployment_file_tells_the_operator(deployed, caplog, lost):
    said: list[Any] = []
    feed, bridge = _StubFeed(), object.__new__(Bridge)
    bridge.report_alert = said.append  # type: ignore[method-assign,assignment]
    others = (
        Component("feed", Feed, lambda _: feed),
        Component("bridge", Bridge, lambda _: bridge),
    )
    companion = Companion(deployed(), [MAP, *others], restart=True, lost_settings=lost)
    feed.ended.interrupt = companion.stop
    with caplog.at_level(logging.WARNING):
        companion.run()
    told = [r.getMessage() for r in caplog.records if "companion.yaml" in r.getMessage()]
    assert len(told) == len(said) == bool(lost)
    assert {of.id for of in said} <= {AlertId.DEPLOYMENT_LOST}


class _Memory:
    """A part that is told how the flight ends."""

    def __init__(self):
        self.log = []


@pytest.mark.parametrize(
    ("fails", "log"), [("", ["stop"]), ("feed", ["leave", "stop"]), ("start", ["leave", "stop"])]
)
def test_an_end_that_is_none_in_order_leaves_what_is_remembered(deployed, fails, log):
    """Each failing start in the air dropped the gate that the killed process had left open, and so
    did an error of the feed: the process after it injected nothing.
    """

    def fail(_):
        if fails == "start":
            raise OSError("no more threads")

    memory, feed, failures = _Memory(), _StubFeed(), []
    health: Any = SimpleNamespace(end=lambda _, is_failure: failures.append(is_failure))
    feed.ended = threading.Event()
    feed.ended.set()
    feed.error = StreamOpenError("gone") if fails == "feed" else None
    part = Component(
        "memory", _Memory, lambda _: memory, start=lambda _: None,
        stop=lambda made: made.log.append("stop"), hand_over=lambda made: made.log.append("leave"),
    )  # fmt: skip
    parts = [MAP, part, Component("health", HealthMonitor, lambda _: health)]
    parts += [Component("feed", Feed, lambda _: feed, start=fail)]
    with (
        pytest.raises(OSError, match="no more")
        if fails == "start"
        else contextlib.suppress(StreamOpenError)
    ):
        Companion(deployed(), parts).run()
    assert memory.log == log
    assert failures == ([] if fails == "start" else [fails == "feed"])  # a failure is alerted


def test_what_happens_is_logged_and_recorded_once_and_every_thread_ends(deployed, tmp_path, caplog):
    def stop_with_last_words(bridge):
        bridge.report_alert(alert(AlertId.ENDING))
        bridge.stop()

    parts = [replace(p, stop=stop_with_last_words) if p.kind is Bridge else p for p in COMPONENTS]
    for i in range(25):  # 5 s of flight
        cv2.imwrite(str(tmp_path / f"{i:02}.png"), np.full((120, 160, 3), 3 * i, np.uint8))
    threads = set(threading.enumerate())
    with EmbeddedSitl(HOME, parameters={**vision_parameters(), **GIMBAL}) as vehicle:
        log = str(tmp_path / "flight.tlog")
        config = deployed(
            tmp_path, settings={"rate_hz": 5.0, "realtime": True},
            bridge={"connection": vehicle.companion_endpoint, "tlog": log},
            record={"folder": str(tmp_path / "record"), "snapshot_interval_s": None},
        )  # fmt: skip
        with caplog.at_level(logging.INFO):
            Companion(config, parts).run()
    assert sleep_until(lambda: set(threading.enumerate()) <= threads, 30.0), threading.enumerate()
    with (tmp_path / "record" / "events.csv").open() as file:
        rows = list(csv.DictReader(file))
    recorded, ids = [row["text"] for row in rows], [row["alert"] for row in rows]
    assert AlertId.ENDING.value in ids  # the record is closed after all that could tell
    logged = [r.getMessage() for r in caplog.records]
    assert ids.count(AlertId.FC_FOUND.value) == 1, recorded
    for text in set(recorded):
        assert logged.count(text) == recorded.count(text), text
    # Nothing is told twice in a row, with other figures included.
    assert all(a != b or not a for a, b in itertools.pairwise(ids)), recorded
    assert (tmp_path / "flight.tlog").stat().st_size > 10_000
