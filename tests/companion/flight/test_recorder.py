import csv
import errno
import itertools
import json
import os
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import CameraModel, CompanionConfig, FeedConfig, RecordConfig
from companion.convert.formats import READERS, WRITERS, MapReference
from companion.errors import DiskFaultError, ReportError
from companion.flight.recorder import (
    ESTIMATE_COLUMNS,
    MANIFEST_NAME,
    Recorder,
    RecordKeeper,
    fresh_folder,
    remove_empty,
    write_manifest,
)
from companion.offline.record import poses, read_columns
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, so3_exp
from localizer.types import Frame, TargetFix, Visibility
from mavlink_bridge.link.clock import utc_us
from tests.companion.estimates import estimated

FRAME = LocalFrame(Geodetic(47.3, 8.5, 450.0))
CAMERA = Camera.from_fov(64, 48, 60)
CAR = TargetFix("car", np.zeros(3), np.eye(3), (3.0, 4.0), 5)


def _recorder(folder, told=None, interval_s=10.0):
    config = RecordConfig(folder=folder, snapshot_interval_s=interval_s)
    return Recorder(config, FRAME, (lambda _: None) if told is None else told.append)


def test_what_is_recorded_can_be_read_back(tmp_path):
    recorder = _recorder(tmp_path, interval_s=1.0)
    pose = Pose(so3_exp([2.0, 0.5, -0.3]), np.array([1.25, -3.5, 120.0]))
    said = {"quality": 0.8, "sequence": 7, "camera": CAMERA, "stage_ms": {"register": 12.5}}
    recorder.estimate(estimated(pose, 1_700_000_000_123_456_789, accepted=False, **said))
    recorder.target(replace(CAR, velocity=np.array([1.0, 2.0, 0.0])))
    recorder.target(replace(CAR, pixel=None, visibility=Visibility.OUTSIDE))
    recorder.event("warning", 'a, "quoted" text\nof two lines')
    image = np.full((48, 64, 3), 200, np.uint8)
    for time_ns in (10**9, 1_500_000_000, 2 * 10**9):
        recorder.snapshot(Frame(image, time_ns, CAMERA, 0))
    recorder.close()
    assert sorted(p.name for p in tmp_path.iterdir()) == [  # no trajectory of a refused estimate
        "estimates.csv", "events.csv", "snapshots", "targets.csv",
    ]  # fmt: skip
    columns = read_columns(tmp_path / "estimates.csv", text=("state", "status"))
    assert tuple(columns) == ESTIMATE_COLUMNS
    assert columns["exposure_time_ns"][0] == 1_700_000_000_123_456_789
    translation, rotation = poses(columns)[0].distance_to(pose)
    assert translation < 1e-3
    assert rotation < 1e-5
    targets = read_columns(tmp_path / "targets.csv", text=("target_id", "visibility"))
    np.testing.assert_array_equal(targets["velocity_north"], [2.0, np.nan])
    np.testing.assert_array_equal(targets["u"], [3.0, np.nan])
    assert list(targets["visibility"]) == ["seen", "outside"]
    with (tmp_path / "events.csv").open(newline="") as file:
        assert next(iter(csv.DictReader(file)))["text"] == 'a, "quoted" text\nof two lines'
    names = sorted(p.stem for p in (tmp_path / "snapshots").glob("*.jpg"))
    assert names == ["1000000000", "2000000000"]


def _estimates(count):
    for n in range(count):
        pose = Pose(so3_exp([2.0, 0.5, -0.3 * n]), np.array([1.25, -3.5 + n, 120.0]))
        time_ns = 1_700_000_000_123_456_789 + n * 10**8
        yield estimated(pose, time_ns, variance=0.04, accepted=n != 1, sequence=n, camera=CAMERA)


def test_the_accepted_estimates_are_a_trajectory_as_convert_makes_it(tmp_path):
    recorder = _recorder(tmp_path)
    for estimate in _estimates(4):
        recorder.estimate(estimate)
    recorder.close()
    place = MapReference(FRAME)
    converted = READERS["record"](tmp_path, place)
    assert len(converted) == 3  # the second was rejected
    for kind, name in (("poses", "poses.txt"), ("tum", "trajectory.tum")):
        written = READERS[kind](tmp_path / name, place)
        WRITERS[kind](tmp_path / "converted", converted, place)
        assert [p.time_ns for p in written] == [
            p.time_ns for p in READERS[kind](tmp_path / "converted", place)
        ]
        for ours, theirs in zip(written, converted, strict=True):
            assert kind == "tum" or ours.name == theirs.name
            translation, rotation = ours.world_from_camera.distance_to(theirs.world_from_camera)
            assert translation < 2e-4  # estimates.csv rounds to 0.1 mm
            assert rotation < 1e-6
    with (tmp_path / "covariances.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["exposure_time_ns"]) for row in rows] == [p.time_ns for p in converted]
    assert {float(row["c00"]) for row in rows} == {0.04}


def test_a_trajectory_that_cannot_be_written_costs_itself_only(tmp_path):
    (tmp_path / "poses.txt").mkdir()
    told: list[Any] = []
    recorder = _recorder(tmp_path, told)
    for estimate in _estimates(4):
        recorder.estimate(estimate)
    recorder.close()
    assert told == ["Is a directory"]
    assert recorder.dropped == 3
    assert len((tmp_path / "estimates.csv").read_text().splitlines()) == 5


@pytest.mark.parametrize(
    ("number", "kind"),
    [(errno.ENOSPC, DiskFaultError), (errno.EROFS, DiskFaultError), (errno.EACCES, ReportError)],
)
def test_a_disk_that_fails_is_told_from_a_wrong_folder(tmp_path, monkeypatch, number, kind):
    """The one may come in flight, and a restart must not fail of it."""

    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(ReportError, match=r"record\.folder") as caught:
        _recorder(tmp_path / "flight")
    assert type(caught.value) is kind


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_a_full_disk_costs_rows_and_not_the_recorder(tmp_path, caplog):
    (tmp_path / "events.csv").symlink_to("/dev/full")
    told: list[Any] = []
    recorder = _recorder(tmp_path, told)
    for _ in range(2000):  # more than a file's buffer holds
        recorder.event("info", "x" * 100)
    recorder.target(CAR)
    recorder.close()
    assert recorder.dropped > 0
    assert told == ["No space left on device"]
    assert sum("record is incomplete" in r.message for r in caplog.records) == 1
    assert Path(tmp_path / "targets.csv").read_text().count("car") == 1


def test_a_restart_spares_the_earlier_record(tmp_path):
    folder = tmp_path / "latest"
    assert fresh_folder(folder) == folder
    for expected in ("latest", "latest-2", "latest-3"):
        chosen = fresh_folder(folder)
        assert chosen.name == expected
        _recorder(chosen).close()


def test_only_a_record_without_a_row_is_removed(tmp_path):
    """Of a start that failed; what else lies in its folder is left alone."""
    kinds = ("empty", "told", "shared")
    for kind in kinds:
        recorder = _recorder(tmp_path / kind)
        if kind == "told":
            recorder.event("info", "something happened")
        recorder.close()
    (tmp_path / "shared" / "notes.txt").write_text("mine")
    for kind in (*kinds, "absent"):
        remove_empty(tmp_path / kind)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["shared", "told"]
    assert [p.name for p in (tmp_path / "shared").iterdir()] == ["notes.txt"]
    assert "something happened" in (tmp_path / "told" / "events.csv").read_text()


def _interrupted_at(step, start):
    """Whether `start` came so far as to be interrupted at its step-th line, here or in pathlib."""
    lines = itertools.count()
    files = (Recorder.__init__.__code__.co_filename, Path.mkdir.__code__.co_filename)

    def trace(frame, event, _):
        if frame.f_code.co_filename not in files:
            return None
        if event == "line" and next(lines) == step:
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        start()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def test_a_start_that_is_interrupted_anywhere_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(threading.Thread, "start", lambda _: None)  # it would outlive the test
    folder = tmp_path / "flight"
    for step in itertools.count():
        if not _interrupted_at(step, lambda: _recorder(folder)):
            break
        remove_empty(folder)
        assert not folder.exists(), f"after {step} lines"
    assert step > 20


def test_what_cannot_be_written_costs_itself_only(tmp_path):
    """No UTF-8 for half a surrogate pair, no picture of nothing: neither is the disk's fault."""
    told: list[Any] = []
    recorder = _recorder(tmp_path, told, 1.0)
    recorder.event("info", "\ud800")
    recorder.snapshot(Frame(np.zeros((0, 0, 3), np.uint8), 10**9, CAMERA, 0))
    recorder.event("info", "afterwards")
    recorder.close()
    assert recorder.dropped == 2
    assert len(told) == 1
    assert "afterwards" in (tmp_path / "events.csv").read_text()


class _StandingDisk:
    """A target whose row takes as long as a disk that stands still."""

    def __init__(self):
        self.still, self.stands = threading.Event(), threading.Event()

    @property
    def position_world(self):
        self.stands.set()
        self.still.wait(60.0)
        raise OSError(errno.EIO, "it stood still")


def test_pictures_that_wait_for_a_disk_are_bounded(tmp_path, monkeypatch):
    """A disk that stood still kept each picture in memory: hundreds of MB in a minute."""
    image = np.zeros((48, 64, 3), np.uint8)
    monkeypatch.setattr("companion.flight.recorder._PICTURES_BYTES", 3 * image.nbytes)
    recorder = _recorder(tmp_path, interval_s=0.001)
    disk = _StandingDisk()
    recorder.target(disk)
    assert disk.stands.wait(60.0)
    for number in range(20):
        recorder.snapshot(Frame(image, 10**9 * (1 + number), CAMERA, number))
    assert recorder.dropped == 17
    disk.still.set()
    recorder.close()
    assert len(list((tmp_path / "snapshots").iterdir())) == 3


def test_a_disk_that_stands_still_is_left_behind(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.flight.recorder._CLOSE_S", 0.2)
    recorder = _recorder(tmp_path)
    disk = _StandingDisk()
    recorder.target(disk)
    assert disk.stands.wait(60.0)
    for _ in range(5000):  # more than the queue holds
        recorder.event("info", "x")
    assert recorder.dropped > 0  # it stands
    assert not recorder.close()
    disk.still.set()  # and its thread ends
    monkeypatch.setattr("companion.flight.recorder._CLOSE_S", 30.0)
    assert recorder.close()


def test_latest_is_the_newest_record_and_never_somebodys_folder(tmp_path):
    keeper = RecordKeeper(FRAME, lambda _: None)
    for name in ("flight", "flight-2"):
        (tmp_path / name).mkdir()
        keeper.folder = tmp_path / name
        keeper.link()
        assert (tmp_path / "latest").resolve().name == name
    (tmp_path / "other" / "latest").mkdir(parents=True)
    keeper.folder = tmp_path / "other" / "flight"
    keeper.link()
    assert not (tmp_path / "other" / "latest").is_symlink()


def test_pictures_and_messages_are_dated_by_one_clock_though_the_wall_clock_steps(
    tmp_path, monkeypatch
):
    """Without a battery a computer's clock steps once it meets the network."""
    before = utc_us()
    monkeypatch.setattr("time.time_ns", lambda: 0)
    model = CameraModel(width=64, height=48, fx=50, fy=50, cx=32, cy=24)
    camera = FeedConfig(source="udp://0.0.0.0:5600", model=model)
    write_manifest(tmp_path, CompanionConfig(map=tmp_path, camera=camera))
    manifest = json.loads((tmp_path / MANIFEST_NAME).read_text())
    assert before * 1000 <= manifest["utc_ns"] < before * 1000 + 60e9
