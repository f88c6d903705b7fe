"""The whole process, wired: an embedded vehicle, a feed of grey pictures, a record."""

import csv
import errno
import itertools
import logging
import os
import threading
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from companion.config import parse_config
from companion.errors import ConfigError, StreamOpenError
from companion.flight.app import Companion
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.messages import TrackRequest, without_figures
from sitl.geodesy import Location
from sitl.vehicles.launch import GIMBAL, EmbeddedSitl, vision_parameters

HOME = Location(47.397742, 8.545594, 488.0)
MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}


def test_an_origin_far_from_the_map_is_never_sent(small_assets, tmp_path):
    """0, 0 or a wrong digit: the vehicle would keep it until it is switched off."""
    origin = {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_amsl_m": 0.0}
    config = parse_config(
        {
            "map": str(small_assets.map_cache),
            "camera": {"source": "udp://127.0.0.1:5", "model": MODEL},
            "bridge": {"connection": "tcp:127.0.0.1:9", "origin": origin},
        },
        "test",
    )
    with pytest.raises(ConfigError, match=r"bridge\.origin: \d+\.\d km beside"):
        Companion(config).run()


def test_a_restart_on_a_full_disk_goes_on_without_a_record(small_assets, tmp_path, monkeypatch):
    """In the air a position is worth more than a record. The feed's error ends the start here."""
    (tmp_path / "image.png").touch()
    config = parse_config(
        {
            "map": str(small_assets.map_cache),
            "camera": {"source": str(tmp_path / "no.mp4"), "model": MODEL},
            "bridge": {"connection": "tcp:127.0.0.1:9", "tlog": str(tmp_path / "a" / "a.tlog")},
            "record": {"folder": str(tmp_path / "record")},
        },
        "test",
    )

    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "mkdir", refuse)
    companion = Companion(config)
    with pytest.raises(StreamOpenError):
        companion.run()
    assert any("record is incomplete: [Errno 28]" in text for text in companion._bridge.texts())


def test_the_order_to_stop_takes_no_lock():
    """It comes from a signal handler, which may interrupt the very lines that hold the lock."""
    config = parse_config({"map": "m", "camera": {"source": "s", "model": MODEL}}, "test")
    companion = Companion(config)
    ordered = threading.Event()

    def order():
        companion.stop()
        ordered.set()

    with companion._feed_ended._cond:
        threading.Thread(target=order, daemon=True).start()
        assert ordered.wait(30.0)


@pytest.mark.parametrize(("age_s", "placed"), [(0.3, True), (2.5, False), (None, False)])
def test_a_click_is_not_placed_by_an_old_pose(age_s, placed):
    """The operator points into the present picture, and is told when nobody knows where it is."""
    second, now_ns = 10**9, 10**12
    companion = Companion(
        parse_config({"map": "m", "camera": {"source": "s", "model": MODEL}}, "test")
    )
    camera = SimpleNamespace(width=160, height=120)
    detections, texts = [], []
    companion._newest = None if age_s is None else SimpleNamespace(
        camera=camera, exposure_time_ns=now_ns - round(age_s * second)
    )  # fmt: skip
    companion._click_refused_ns = 0
    companion._targets = SimpleNamespace(add_detection=detections.append)
    companion._bridge = SimpleNamespace(say=lambda _, text: texts.append(text))
    for k in range(5):  # an impatient operator
        companion._on_track(TrackRequest("point", now_ns + k, (0.5, 0.25)))
    companion._on_track(TrackRequest("stop", now_ns))
    assert [(d.u, d.v) for d in detections] == ([(80.0, 30.0)] * 5 if placed else [])
    told = ["PiLoT: no target: the camera's position is not known"]
    assert texts == ([] if placed else told)


def test_what_happens_is_logged_and_recorded_once_and_every_thread_ends(
    small_assets, tmp_path, caplog, monkeypatch
):
    stop, last = Bridge.stop, iter(["PiLoT: last words"])

    def stop_with_last_words(bridge):
        for text in last:
            bridge.say(6, text)
        stop(bridge)

    monkeypatch.setattr(Bridge, "stop", stop_with_last_words)
    for i in range(40):
        cv2.imwrite(str(tmp_path / f"{i:02}.png"), np.full((120, 160, 3), 3 * i, np.uint8))
    threads = set(threading.enumerate())
    with EmbeddedSitl(HOME, parameters={**vision_parameters(), **GIMBAL}) as vehicle:
        settings = {"rate_hz": 5.0, "realtime": True}
        config = parse_config(
            {
                "map": str(small_assets.map_cache),
                "camera": {"source": str(tmp_path), "model": MODEL, "settings": settings},
                "bridge": {
                    "connection": vehicle.companion_endpoint,
                    "tlog": str(tmp_path / "flight.tlog"),
                },
                "record": {"folder": str(tmp_path / "record"), "snapshot_interval_s": None},
            },
            "test",
        )
        with caplog.at_level(logging.INFO):
            Companion(config).run()
    assert sleep_until(lambda: set(threading.enumerate()) <= threads, 30.0), threading.enumerate()
    with (tmp_path / "record" / "events.csv").open() as file:
        recorded = [row["text"] for row in csv.DictReader(file)]
    assert "PiLoT: last words" in recorded  # the record is closed after all that could tell
    logged = [r.getMessage() for r in caplog.records]
    assert recorded.count("PiLoT: flight controller found") == 1, recorded
    for text in set(recorded):
        assert logged.count(text) == recorded.count(text), text
    # Nothing is told twice in a row, in other words or with other figures included.
    plain = [without_figures(text.removeprefix("PiLoT: ")) for text in recorded]
    assert all(a != b for a, b in itertools.pairwise(plain)), recorded
    assert (tmp_path / "flight.tlog").stat().st_size > 10_000
