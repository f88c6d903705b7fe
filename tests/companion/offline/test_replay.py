"""A flight of the whole process over recorded images, and the same flight again from its record."""

import csv
import json
import socket
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.config import parse_config
from companion.errors import RecordError
from companion.flight.app import Companion
from companion.geometry import GIMBAL_FROM_CAMERA
from companion.offline.record import load_record, read_record
from companion.offline.replay import RecordedAutopilot, replay, summarize
from companion.reporting.pictures import map_pictures
from companion.sources.zoom import ZoomTable
from localizer.geometry.camera import Camera
from localizer.geometry.geo import NED_FROM_ENU
from localizer.geometry.pose import quaternion_from_matrix
from localizer.geometry.trajectory import read_poses, world_from_camera
from localizer.map.cache.cache import TileCache
from localizer.tracking.engine import DualThreadEngine
from mavlink_bridge.link.tlog import read_tlog
from sitl.demo.kinematic import record_scenario
from sitl.demo.scenario import CameraSpec, Scenario, ScenarioLeg
from tests.companion.sources.paced_sender import free_port

FRAMES_AT_LEAST = 6


class Autopilot(threading.Thread):
    """A vehicle that stands in the air where the first image was taken, over UDP."""

    def __init__(self, port, row, pose, geoid_separation_m):
        super().__init__(daemon=True)
        self._to = ("127.0.0.1", port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._codec = mavlink.MAVLink(None, 1, 1)
        self._boot_ns = time.monotonic_ns() - 60 * 10**9
        ned_from_gimbal = NED_FROM_ENU @ pose.rotation @ GIMBAL_FROM_CAMERA.T
        self._q = quaternion_from_matrix(ned_from_gimbal)
        p = row.position
        self._place = (
            round(p.latitude_deg * 1e7), round(p.longitude_deg * 1e7),
            round((p.height_m - geoid_separation_m) * 1e3),
        )  # fmt: skip
        self._stop_event = threading.Event()

    def run(self):
        count = 0
        while not self._stop_event.wait(0.04):
            ms = (time.monotonic_ns() - self._boot_ns) // 1_000_000
            if count % 10 == 0:
                self._send(
                    mavlink.MAVLink_heartbeat_message(
                        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 4, 4, 3
                    )
                )
            self._send(mavlink.MAVLink_attitude_message(ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            self._send(mavlink.MAVLink_global_position_int_message(ms, *self._place, 0, 0, 0, 0, 0))
            self._send(  # healthy GNSS
                mavlink.MAVLink_gps_raw_int_message(
                    ms * 1000, 3, *self._place, 80, 80, 0, 0, 12, h_acc=800, v_acc=1200
                )
            )
            self._send(mavlink.MAVLink_gimbal_device_attitude_status_message(
                0, 0, ms, mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME, list(self._q),
                0.0, 0.0, 0.0, 0))  # fmt: skip
            count += 1

    def stop(self):
        self._stop_event.set()
        self.join()
        self._socket.close()

    def _send(self, message):
        self._socket.sendto(message.pack(self._codec), self._to)
        self._codec.seq = (self._codec.seq + 1) % 256


def at_the_engines_pace(submit):
    """`DualThreadEngine.submit` that holds the feed until every thread has done with the frame,
    however busy the machine is: a frame that is dropped, or registered to a reference of a second
    ago, makes another flight than the one that is localized again.
    """

    def paced(engine, frame):
        at, deadline_s = time.monotonic_ns(), time.monotonic() + 30.0
        submit(engine, frame)
        for thread in ("extract", "localize", "render"):
            while (begun_ns := engine.last_ticks_ns().get(thread, 0)) <= at:
                if time.monotonic() > deadline_s:
                    return
                time.sleep(1e-3)
            at = begun_ns

    return paced


@pytest.fixture(scope="module")
def record(small_assets, tmp_path_factory):
    """The folder that a flight of some seconds leaves."""
    folder = tmp_path_factory.mktemp("flight")
    leg = ScenarioLeg(east_m=0, north_m=16, height_m=80, gimbal_pitch_deg=-85)
    camera = CameraSpec(width=480, height=360, rate_hz=5)
    scenario = Scenario(takeoff_height_m=80, legs=(leg,), cars=1, people=0, camera=camera).ideal()
    sequence = folder / "sequence"
    record_scenario(small_assets, scenario, 5, sequence)
    (sequence / "images" / "timestamps.txt").unlink()  # of another clock
    cache = TileCache.open(small_assets.map_cache)
    row = read_poses(sequence / "poses.txt")[0]
    pose, port = world_from_camera(row, cache.frame), free_port()
    model = Camera.from_json(sequence / "camera.json").to_dict()
    config = parse_config(
        {
            "map": str(small_assets.map_cache),
            "camera": {
                "source": str(sequence / "images"),
                "model": model,
                "settings": {"realtime": True, "rate_hz": 3.0},
            },
            "localizer": {"width": 256},
            "bridge": {
                "connection": f"udpin:127.0.0.1:{port}", "tlog": str(folder / "flight.tlog"),
            },
            "record": {"folder": str(folder / "record"), "snapshot_interval_s": 0.001},
        },
        "test",
    )  # fmt: skip
    autopilot = Autopilot(port, row, pose, cache.manifest.geoid_separation_m)
    autopilot.start()
    paced = at_the_engines_pace(DualThreadEngine.submit)
    try:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(DualThreadEngine, "submit", paced)
            Companion(config).run()  # until the images end
    finally:
        autopilot.stop()
    return folder / "record"


def _rows(record):
    with (record / "estimates.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_recorded_flight_localizes_again_as_it_did(record):
    loaded = load_record(record)
    assert sum(e.accepted for e in loaded.estimates) >= FRAMES_AT_LEAST
    summary = summarize(replay(loaded))
    assert summary.frames == len(loaded.estimates)
    assert summary.agrees(tolerance_m=0.5), summary
    assert np.median(summary.translation_m) < 0.2
    assert np.median(summary.rotation_deg) < 0.2


def test_the_command_tells_a_record_that_agrees_from_one_that_does_not(record, tmp_path):
    assert CliRunner().invoke(app, ["replay", str(record)]).exit_code == 0
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("record.json", "snapshots"):
        (moved / name).symlink_to(record / name)
    rows = _rows(record)
    with (moved / "estimates.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(
            r | {"east_m": str(float(r["east_m"]) + 2.0), "latitude_deg": ""} for r in rows
        )
    result = CliRunner().invoke(app, ["replay", str(moved)])
    assert result.exit_code == 1
    assert "differs" in result.output


def test_a_map_that_was_built_again_about_another_origin_is_refused(record):
    """All places of the record lay beside it by the same way, and nobody was told."""
    loaded = load_record(record)
    flown = TileCache.open(loaded.config.map)
    loaded.tables.flown_map.require_frame(flown)
    assert not loaded.tables.flown_map.mismatch(flown)
    origin = replace(
        flown.manifest.origin, longitude_deg=flown.manifest.origin.longitude_deg + 1e-4
    )
    again = TileCache(flown.path, flown.manifest.model_copy(update={"origin": origin}), flown.index)
    with pytest.raises(RecordError, match=r"another origin .* 8 m away: was it built again"):
        loaded.tables.flown_map.require_frame(again)


def test_a_map_that_was_built_again_about_the_same_origin_is_doubted(record, tmp_path):
    """The replay said `differs`, and of what was left to guess; reports drew over it in silence."""
    loaded = load_record(record)
    again = tmp_path / "again"
    again.mkdir()
    flown = TileCache.open(loaded.config.map)
    for name in ("manifest.json", "index.safetensors"):
        (again / name).write_bytes((loaded.config.map / name).read_bytes())
    (again / "manifest.json").write_text(
        flown.manifest.model_copy(update={"gsd_m": 9.0}).model_dump_json()
    )
    built = TileCache.open(again)
    loaded.tables.flown_map.require_frame(built)
    mismatch = loaded.tables.flown_map.mismatch(built)
    assert "not the map that was flown over: was it built again" in mismatch
    assert not replace(loaded.tables.flown_map, sha256=None).mismatch(built)  # an older record
    tables = read_record(record)
    with map_pictures(again, flown=tables.flown_map) as pictures:
        assert any("built again" in note for note in pictures.notes)
    with map_pictures(loaded.config.map, flown=tables.flown_map) as pictures:
        assert pictures.notes == []
    assert tables.flown_map.point is not None
    moved = replace(tables.flown_map, point=tables.flown_map.point + 5.0)
    with map_pictures(loaded.config.map, flown=moved) as pictures:
        assert pictures.cache is None
        assert any("another origin" in note for note in pictures.notes)


def test_what_a_record_lacks_is_named(record, tmp_path):
    with pytest.raises(RecordError, match="not a flight's record"):
        load_record(tmp_path)
    (tmp_path / "record.json").symlink_to(record / "record.json")
    (tmp_path / "estimates.csv").symlink_to(record / "estimates.csv")
    with pytest.raises(RecordError, match=r"have no image.*snapshot_interval_s"):
        load_record(tmp_path)


def test_a_manifest_that_nests_without_end_is_named(tmp_path):
    (tmp_path / "record.json").write_text(100_000 * "[")
    with pytest.raises(RecordError, match="not a flight's record"):
        load_record(tmp_path)


def test_the_manifest_dates_the_tlog_and_says_what_flew(record):
    manifest = json.loads((record / "record.json").read_text())
    assert manifest["config"]["localizer"]["width"] == 256
    assert {"python", "numpy"} <= set(manifest["versions"])
    loaded = load_record(record)
    times = [utc - loaded.log.ahead_ns for utc, _ in read_tlog(
        loaded.config.bridge.tlog)]  # fmt: skip
    exposures = [e.exposure_time_ns for e in loaded.estimates]
    assert loaded.tables.start_ns <= min(exposures)
    assert min(times) < min(exposures) < max(exposures) < max(times) + 10**9
    assert times == sorted(times)


def _copy_of(record, tmp_path):
    folder = tmp_path / "copy"
    (folder / "snapshots").mkdir(parents=True)
    for name in ("record.json", "estimates.csv"):
        (folder / name).write_bytes((record / name).read_bytes())
    for image in (record / "snapshots").iterdir():
        (folder / "snapshots" / image.name).symlink_to(image)
    return folder


def test_a_row_that_a_loss_of_power_cut_short_is_left_out(record, tmp_path):
    folder = _copy_of(record, tmp_path)
    whole = load_record(folder).estimates
    text = (folder / "estimates.csv").read_text()
    (folder / "estimates.csv").write_text(text[: len(text) - 40])
    assert [e.sequence for e in load_record(folder).estimates] == [e.sequence for e in whole[:-1]]


@pytest.mark.parametrize(
    ("column", "value"),
    [("latency_ms", "inf"), ("focal_px", "-1"), ("focal_px", "inf"), ("qw", "nan"),
     ("east_m", "x"), ("sequence", ""), ("exposure_time_ns", 400 * "9"),
     ("exposure_time_ns", "-1")],
)  # fmt: skip
def test_a_row_that_is_no_estimate_is_named(record, tmp_path, column, value):
    folder = _copy_of(record, tmp_path)
    rows = _rows(record)
    with (folder / "estimates.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows([*rows, rows[0] | {column: value}])
    with pytest.raises(RecordError, match="not a table of a record"):
        load_record(folder)


def test_each_frame_is_replayed_with_the_focal_length_that_it_had(record, tmp_path, monkeypatch):
    """All pictures of a zoomed flight had the model's."""
    rows = _rows(record)
    focal = float(rows[0]["focal_px"])
    flown = [focal * (1.0 if k < 3 else 2.0) for k in range(len(rows))]
    folder = _copy_of(record, tmp_path)
    with (folder / "estimates.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(r | {"focal_px": f} for r, f in zip(rows, flown, strict=True))
    seen = []

    class Localizer:
        tracker = SimpleNamespace(track_status=SimpleNamespace(wants_prior=False))

        def track(self, frame):
            seen.append(frame.camera.fx)

    monkeypatch.setattr("companion.offline.replay.build_localizer", lambda *_: Localizer())
    loaded = load_record(folder)
    replay(loaded)
    assert seen == pytest.approx(flown, rel=1e-4)


def test_an_older_record_of_a_camera_that_zooms_is_replayed_by_its_log_or_told(
    record, monkeypatch, caplog
):
    """All its pictures had the model's focal length: metres off, and as good as any to look at."""
    loaded, seen = load_record(record), []
    old = tuple(replace(e, focal_px=None) for e in loaded.estimates)
    zooms_ns, unknown_ns = old[2].exposure_time_ns, old[-1].exposure_time_ns
    model = loaded.config.camera.model

    class Localizer:
        tracker = SimpleNamespace(track_status=SimpleNamespace(wants_prior=False))

        def track(self, frame):
            seen.append(frame.camera.fx / model.fx)

    def zoom_at(_, time_ns, hold_s):
        assert hold_s == 5.0
        return None if time_ns == unknown_ns else 50.0 if time_ns >= zooms_ns else 0.0

    def replayed(zoom):
        seen.clear()
        caplog.clear()
        camera = loaded.config.camera.model_copy(update={"zoom": zoom})
        config = loaded.config.model_copy(update={"camera": camera})
        frames = replay(replace(loaded, config=config, estimates=old))
        return [f.recorded for f in frames]

    monkeypatch.setattr("companion.offline.replay.build_localizer", lambda *_: Localizer())
    monkeypatch.setattr(RecordedAutopilot, "zoom_at", zoom_at)
    assert replayed(ZoomTable(points=((0, 1), (100, 4)), hold_s=5.0)) == list(old)
    assert seen == pytest.approx([1.0] * 2 + [2.0] * (len(old) - 3), rel=1e-3)
    assert f"1 of {len(old)} frames are not localized again" in caplog.text
    assert replayed(None) == list(old)  # false alarm: a camera that does not zoom
    assert seen == pytest.approx([1.0] * len(old))
    assert not caplog.records


def test_damaged_images_are_no_agreement(record, tmp_path):
    folder = _copy_of(record, tmp_path)
    for image in (folder / "snapshots").iterdir():
        image.unlink()
        image.touch()
    loaded = load_record(folder)
    with pytest.raises(RecordError, match=r"only 0 of \d+ images in snapshots can be read"):
        replay(loaded)
