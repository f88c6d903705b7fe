"""A record as MCAP, read back by MCAP's own reader with the schemas that the file carries."""

import json
import os
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner

pytest.importorskip("mcap_protobuf")
pytest.importorskip("foxglove_schemas_protobuf")
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from companion.cli.commands import app
from companion.config import CompanionConfig, RecordConfig
from companion.errors import RecordError, ReportError
from companion.export.mcap_export import export_mcap
from companion.flight.recorder import RecordKeeper
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.types import Frame, TargetFix
from mavlink_bridge.link.tlog import TlogRecorder
from tests.companion.estimates import estimated

BEGIN_NS = 5_000_000_000
DOWN = Pose(np.diag([1.0, -1.0, -1.0]), np.array([12.5, -3.25, 80.0]))
MODEL = {
    "width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 32.0, "cy": 24.0,
    "distortion": [-0.1, 0.02, 0.001, -0.002, 0.003],
}  # fmt: skip


def _read(path):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages: dict[Any, Any] = {}
        topics = {c.topic for c in reader.get_summary().channels.values()} - {"/diagnostics"}
        for schema, channel, message, value in reader.iter_decoded_messages(topics):
            messages.setdefault(channel.topic, []).append((schema.name, message.log_time, value))
        return messages, [a.name for a in reader.iter_attachments()]


def _diagnostics(path):
    with path.open("rb") as file:
        reader = make_reader(file)
        found = list(reader.iter_messages(topics=["/diagnostics"]))
        return [(s, json.loads(m.data)) for s, _, m in found]


@pytest.fixture
def flight(tmp_path, small_assets):
    """Fly a record of two estimates, the second refused; returns its folder."""

    def fly(*, close=True):
        record = RecordConfig(folder=tmp_path / "flight", snapshot_interval_s=1.0)
        config = CompanionConfig(
            map=small_assets.map_cache, record=record,
            camera={"source": "udp://127.0.0.1:1", "model": MODEL},
            bridge={"tlog": tmp_path / "flight.tlog"},
        )  # fmt: skip
        keeper = RecordKeeper(TileCache.open(small_assets.map_cache).frame, pytest.fail)
        keeper.open(config, record, lambda _: None)
        recorder, camera = keeper.recorder, config.camera.model.camera()
        covariance = np.diag([0.04, 0.09, 0.25, 1e-4, 1e-4, 1e-4])
        stage_ms = {"register": 9.5, "latency": 90.0}
        first = estimated(
            DOWN, BEGIN_NS, covariance=covariance, quality=0.8, camera=camera, stage_ms=stage_ms
        )
        later_ns = BEGIN_NS + 100_000_000
        refused = replace(first, accepted=False, exposure_time_ns=later_ns, sequence=1)
        recorder.estimate(first, (2.5, 2.0))
        recorder.estimate(refused)
        recorder.target(
            TargetFix("car", np.array([20.0, 5.0, 1.0]), np.eye(3), (3.0, 4.0), later_ns)
        )
        recorder.event("warning", "no fixes")
        recorder.snapshot(Frame(np.full((48, 64, 3), 90, np.uint8), BEGIN_NS, camera, 0))
        if close:
            keeper.close()
        return keeper

    return fly


def test_a_record_is_what_foxglove_expects(flight, small_assets):
    keeper = flight()
    written = export_mcap(keeper.folder)
    messages, attached = _read(written.path)
    manifest = json.loads((keeper.folder / "record.json").read_text())
    utc_ns = BEGIN_NS + manifest["utc_ns"] - manifest["monotonic_ns"]

    frame = TileCache.open(small_assets.map_cache).frame
    ((schema, logged, location),) = messages["/vision/location"]  # the refused one gives none
    assert (schema, logged) == ("foxglove.LocationFix", utc_ns)
    assert location.timestamp.ToNanoseconds() == utc_ns
    east, north, up = frame.enu_from_geodetic(
        location.latitude, location.longitude, location.altitude
    )
    np.testing.assert_allclose((east, north, up), DOWN.translation, atol=1e-3)
    np.testing.assert_allclose(
        np.diag(np.reshape(location.position_covariance, (3, 3))), [0.04, 0.09, 0.25], atol=1e-4
    )

    ((schema, _, pose),) = messages["/vision/pose"]
    assert (schema, pose.frame_id) == ("foxglove.PoseInFrame", "map")
    q = pose.pose.orientation
    np.testing.assert_allclose(np.abs([q.w, q.x, q.y, q.z]), [0, 1, 0, 0], atol=1e-6)
    ((schema, _, tf),) = messages["/tf"]
    assert schema == "foxglove.FrameTransforms"
    assert (tf.transforms[0].parent_frame_id, tf.transforms[0].child_frame_id) == ("map", "camera")

    ((schema, _, image),) = messages["/camera/image"]
    assert (schema, image.format, image.data[:2]) == (
        "foxglove.CompressedImage",
        "jpeg",
        b"\xff\xd8",
    )
    ((schema, _, calibration),) = messages["/camera/calibration"]
    assert schema == "foxglove.CameraCalibration"
    assert image.frame_id == calibration.frame_id == "camera"
    np.testing.assert_allclose(np.reshape(calibration.K, (3, 3))[:2, 2], [31.5, 23.5])
    assert list(calibration.D) == MODEL["distortion"]

    ((schema, _, scene),) = messages["/targets"]
    (entity,) = scene.entities
    assert (schema, entity.id, entity.frame_id) == ("foxglove.SceneUpdate", "car", "map")
    assert entity.spheres[0].pose.position.x == 20.0
    assert "car" in entity.texts[0].text
    ((schema, _, point),) = messages["/targets/map"]
    assert schema == "foxglove.GeoJSON"
    assert json.loads(point.geojson)["geometry"]["type"] == "Point"

    ((schema, _, event),) = messages["/events"]
    assert (schema, event.message, event.level) == ("foxglove.Log", "no fixes", event.WARNING)
    assert attached == ["record.json"]


def test_diagnostics_tell_refused_estimates_too_and_follow_their_schema(flight):
    written = export_mcap(flight().folder)
    rows = _diagnostics(written.path)
    schema = json.loads(rows[0][0].data)
    assert rows[0][0].encoding == "jsonschema"
    assert [row["accepted"] for _, row in rows] == [True, False]
    assert (rows[0][1]["hpl_m"], rows[1][1].get("hpl_m")) == (2.5, None)
    for _, row in rows:
        assert set(schema["required"]) <= set(row) <= set(schema["properties"])


def test_mavlink_text_and_the_autopilots_place_come_from_the_tlog(flight, tmp_path):
    keeper = flight()
    codec = mavlink.MAVLink(None, 1, 1)
    log = TlogRecorder(tmp_path / "flight.tlog")
    log.start()
    for message in (
        mavlink.MAVLink_statustext_message(4, b"EKF3 lane switch"),
        mavlink.MAVLink_global_position_int_message(1, 473000000, 85000000, 500_000, 0, 0, 0, 0, 0),
        mavlink.MAVLink_gps_raw_int_message(1, 3, 473000000, 85000000, 500_000, 0, 0, 0, 0, 12,
                                            h_acc=800),
        mavlink.MAVLink_gps_raw_int_message(1, 1, 0, 0, 0, 0, 0, 0, 0, 0),  # no fix: no place
    ):  # fmt: skip
        log.write(message.pack(codec), time.time_ns() // 1000)
    log.close()
    messages, _ = _read(export_mcap(keeper.folder).path)
    ((_, _, text),) = messages["/mavlink/text"]
    assert (text.message, text.level, text.name) == ("EKF3 lane switch", text.WARNING, "1/1")
    ((_, _, autopilot),) = messages["/autopilot/location"]
    ((_, _, gnss),) = messages["/gnss/location"]
    assert autopilot.latitude == pytest.approx(47.3)
    assert gnss.position_covariance[0] == pytest.approx(0.64)
    # Brought elsewhere, with its log beside it: the settings name a place that is gone.
    elsewhere = tmp_path / "stick"
    elsewhere.mkdir()
    for path in (keeper.folder, tmp_path / "flight.tlog"):
        path.rename(elsewhere / path.name)
    moved, _ = _read(export_mcap(elsewhere / keeper.folder.name).path)
    assert len(moved["/mavlink/text"]) == 1


def test_what_is_no_record_says_so_and_leaves_no_file(tmp_path):
    with pytest.raises(RecordError, match="not a flight's record"):
        export_mcap(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_command_asks_for_a_format_and_names_the_file(flight):
    keeper = flight()
    missing = CliRunner().invoke(app, ["export", str(keeper.folder)])
    assert missing.exit_code != 0
    done = CliRunner().invoke(app, ["export", str(keeper.folder), "--mcap"])
    assert done.exit_code == 0, done.output
    assert "record.mcap" in done.output
    read, _ = _read(keeper.folder / "record.mcap")
    diagnostics = _diagnostics(keeper.folder / "record.mcap")
    count = len(diagnostics) + sum(len(of_topic) for of_topic in read.values())
    # Two estimates, a target, an event, a picture: rows, of which some are several messages.
    assert f"{count} messages of 5 rows" in done.output
    assert "no MAVLink" in done.output  # the .tlog was never written


def test_it_is_put_in_the_place_of_no_device_and_no_table(flight, tmp_path):
    """A rename puts it there, by which root would have lost /dev/full."""
    keeper = flight()
    os.mkfifo(tmp_path / "a.mcap")
    with pytest.raises(ReportError, match=r"a\.mcap: is a folder or a device"):
        export_mcap(keeper.folder, tmp_path / "a.mcap")
    table = keeper.folder / "estimates.csv"
    before = table.read_bytes()
    with pytest.raises(ReportError, match=r"estimates\.csv: give a file that ends in \.mcap"):
        export_mcap(keeper.folder, table)
    report = CliRunner().invoke(app, ["report", str(keeper.folder), "--out", str(table)])
    assert "give a file that ends in .html" in str(report.exception)
    assert table.read_bytes() == before
