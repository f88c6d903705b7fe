"""Video sent on with its metadata: the camera's own bytes, and the record's fields.

Read back with FFmpeg's demuxer and two parsers that know nothing of ours.
"""

from __future__ import annotations

import csv
import io
import json
import socket
import time
from fractions import Fraction

import av
import klvdata
import numpy as np
import pytest
from stanag4609.st0601 import decode_uas_local_set

from companion.config import CompanionConfig, KlvConfig, RecordConfig
from companion.errors import RecordError, StreamOpenError
from companion.flight.recorder import RecordKeeper
from companion.klv.metadata import KlvContext, frame_fields
from companion.klv.relay import KlvRelay
from companion.reporting.klv_recording import describe_recording
from companion.sources import SourceSettings, VideoFileSource
from companion.sources.timing import MispTime, sei_nal
from companion.targets.target_manager import TargetEstimate
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, matrix_from_euler, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.types import TargetFix
from tests.companion.estimates import DOWN, estimated
from tests.companion.targets import scene as flat

CAMERA = Camera(160, 120, 140.0, 140.0, 80.0, 60.0)
SECOND = 10**9
RATE = 10
PLACE = Geodetic(47.4, 8.5, 500.0)
SCENE = KlvContext(LocalFrame(PLACE), flat.cast, 47.0, "survey 7")


def write_video(path, count, stamps=None, b_frames=0):
    """Frames of moving grey at 10 Hz; stamps: UTC in ns of each, as MISP SEI."""
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = CAMERA.width, CAMERA.height, "yuv420p"
    encoder.time_base, encoder.framerate = Fraction(1, 90_000), Fraction(RATE)
    encoder.options = {"bf": str(b_frames), "g": "5", "preset": "ultrafast"}
    if not b_frames:
        encoder.options |= {"tune": "zerolatency"}
    with av.open(str(path), "w", format="mpegts") as out:
        stream = out.add_stream("libx264", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = CAMERA.width, CAMERA.height, "yuv420p"
        for k in range(count + 1):
            picture = None
            if k < count:
                image = np.full((120, 160, 3), 40 + 5 * k, np.uint8)
                image[30:60, 4 * k : 4 * k + 30] = 250
                picture = av.VideoFrame.from_ndarray(image, "rgb24").reformat(format="yuv420p")
                picture.pts, picture.time_base = 90_000 // RATE * k, Fraction(1, 90_000)
            for encoded in encoder.encode(picture):
                stamp = b""
                if stamps is not None:
                    stamp = sei_nal(MispTime(stamps[encoded.pts // (90_000 // RATE)] // 1000, True))
                packet = av.Packet(stamp + bytes(encoded))
                packet.pts, packet.dts, packet.time_base = (
                    encoded.pts, encoded.dts, Fraction(1, 90_000),
                )  # fmt: skip
                packet.is_keyframe, packet.stream = encoded.is_keyframe, stream
                out.mux(packet)


def read_stream(source):
    """Video packets' payloads, and the metadata packets by presentation time, s."""
    video, metadata = [], {}
    with av.open(source, format="mpegts") as container:
        kinds = [(s.type, s.codec_context and s.codec_context.name) for s in container.streams]
        for packet in container.demux():
            if packet.size and packet.stream.type == "video":
                video.append(bytes(packet))
            elif packet.size:
                metadata[float(packet.pts * packet.time_base)] = bytes(packet)
    return kinds, video, metadata


def fields_of(packet):
    """By stanag4609, after klvdata agreed on the sensor's place."""
    read = {f.definition.tag: f.value for f in decode_uas_local_set(packet).fields}
    (other,) = klvdata.StreamParser(packet)
    assert float(other.items[b"\x0d"].value.value) == pytest.approx(float(read[13]), abs=1e-9)
    return {n: float(v) if isinstance(v, int | float) else v for n, v in read.items()}


def estimate(time_ns, east=0.0, accepted=True, tilt=0.0):
    pose = Pose(so3_exp([tilt, 0.0, 0.0]) @ DOWN, np.array([east, 0.0, 100.0]))
    return estimated(pose, time_ns, quality=0.8, accepted=accepted, camera=CAMERA)


def test_the_fields_of_a_picture_are_where_it_was_taken_and_what_it_shows():
    """A camera at 100 m over flat ground, looking down: everything can be told by hand."""
    target = TargetFix("t", np.array([10.0, -20.0, 0.0]), np.diag([0.5, 0.5, 4.0]), None, 0)
    body = matrix_from_euler(0.0, 0.1, np.radians(30.0))
    fields = frame_fields(estimate(0, east=50.0), SCENE, body, target)
    frame = SCENE.frame
    under = frame.position(np.array([50.0, 0.0, 0.0]))
    assert fields[23] == pytest.approx(under.latitude_deg, abs=1e-8)
    assert fields[24] == pytest.approx(under.longitude_deg, abs=1e-8)
    assert (fields[21], fields[15]) == pytest.approx((100.0, 600.0 - 47.0), abs=1e-3)
    assert fields[25] == pytest.approx(500.0 - 47.0, abs=1e-3)
    assert fields[16] == pytest.approx(2 * np.degrees(np.arctan(80 / 140)))
    half_w, half_h = 100.0 * 80 / 140, 100.0 * 60 / 140
    for k, (east, north) in enumerate(((-1, 1), (1, 1), (1, -1), (-1, -1))):
        corner = frame.position(np.array([50.0 + east * half_w, north * half_h, 0.0]))
        assert fields[26 + 2 * k] == pytest.approx(
            corner.latitude_deg - float(fields[23]), abs=1e-7
        )
        assert fields[27 + 2 * k] == pytest.approx(
            corner.longitude_deg - float(fields[24]), abs=1e-7
        )
    assert (fields[5], fields[6], fields[7]) == pytest.approx((30.0, np.degrees(0.1), 0.0))
    # Platform and camera angles together give the camera's own direction: down, top to the north.
    on_body = matrix_from_euler(*np.radians([fields[20], fields[19], fields[18]]))
    np.testing.assert_allclose((body @ on_body)[:, 0], [0, 0, 1], atol=2e-5)
    np.testing.assert_allclose((body @ on_body)[:, 2], [-1, 0, 0], atol=2e-5)
    assert fields[45] == pytest.approx(2.146 * np.sqrt(0.5))
    assert fields[46] == pytest.approx(1.645 * 2.0)
    unknown = frame_fields(estimate(0), SCENE)
    assert not {5, 6, 7, 18, 19, 20, 40, 41, 42} & set(unknown)
    level = frame_fields(estimate(0, tilt=np.pi / 2), SCENE)
    assert not {21, 23, 24, 25, 26, 40} & set(level)


def test_a_live_video_is_sent_on_byte_for_byte_with_its_metadata_in_step(tmp_path):
    write_video(tmp_path / "in.ts", 12)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        config = KlvConfig(
            output=f"udp://127.0.0.1:{listener.getsockname()[1]}", mission="survey 7", hold_ms=2000
        )
        relay = KlvRelay(config, SCENE, lambda _: np.eye(3), 1_790_000_000 * SECOND)
        source = VideoFileSource(tmp_path / "in.ts", CAMERA, SourceSettings(), None, relay)
        times = []
        for frame in source.frames():
            times.append(frame.exposure_time_ns)
            east = 2.0 * len(times)
            one = estimate(times[-1], east, len(times) % 3 != 0)
            below = np.array([east, 0.0, 0.0])
            fix = TargetFix("car", below, np.eye(3), None, times[-1])
            relay.add_target(TargetEstimate(fix, one))
            relay.add_estimate(one)
        relay.start()  # all targets are told by now, and each picture has its own
        end = time.monotonic() + 30.0
        while relay.sent < 12 and time.monotonic() < end:
            time.sleep(0.01)
        relay.stop()
        listener.setblocking(False)
        data = b""
        while True:
            try:
                data += listener.recv(65536)
            except BlockingIOError:
                break
    assert (relay.sent, relay.dropped, relay.failed, relay.described) == (12, 0, 0, 8)
    kinds, video, metadata = read_stream(io.BytesIO(data))
    assert [kind for kind, _ in kinds] == ["video", "data"]
    _, original, _ = read_stream(str(tmp_path / "in.ts"))
    assert video == original  # nothing was encoded again
    accepted = [k for k in range(12) if (k + 1) % 3 != 0]
    first = min(metadata)
    assert [round((pts - first) * RATE) for pts in sorted(metadata)] == accepted
    for k, pts in zip(accepted, sorted(metadata), strict=True):
        fields = fields_of(metadata[pts])
        taken_us = (times[k] + 1_790_000_000 * SECOND) // 1000
        assert round(fields[2].timestamp() * 1e6) == taken_us
        place = SCENE.frame.position(np.array([2.0 * (k + 1), 0.0, 100.0]))
        assert fields[14] == pytest.approx(place.longitude_deg, abs=1e-7)
        assert fields[41] == pytest.approx(place.longitude_deg, abs=1e-7)


def test_a_picture_without_a_pose_does_not_hold_the_video_up_for_ever(tmp_path):
    """Nobody localizes, and nobody listens: the packets go on, and the flight too."""
    write_video(tmp_path / "in.ts", 5)
    relay = KlvRelay(KlvConfig(output="udp://127.0.0.1:9", hold_ms=20), SCENE, lambda _: None, 0)
    relay.start()
    source = VideoFileSource(tmp_path / "in.ts", CAMERA, SourceSettings(), None, relay)
    assert len(list(source.frames())) == 5
    end = time.monotonic() + 30.0
    while relay.sent + relay.failed < 5 and time.monotonic() < end:
        time.sleep(0.01)
    relay.stop()
    assert relay.described == 0
    assert relay.sent + relay.failed >= 5


@pytest.fixture
def flown(tmp_path, small_assets):
    """A record of nine estimates over the small world, the third refused."""
    record = RecordConfig(folder=tmp_path / "record")
    model = CAMERA.to_dict() | {"distortion": [0.0] * 5}
    config = CompanionConfig(
        map=small_assets.map_cache, record=record,
        camera={"source": "udp://127.0.0.1:1", "model": model},
    )  # fmt: skip
    cache = TileCache.open(small_assets.map_cache)
    keeper = RecordKeeper(cache.frame, pytest.fail)
    keeper.open(config, record, lambda _: None)
    clocks = json.loads((record.folder / "record.json").read_text())
    begin_ns = clocks["monotonic_ns"] + SECOND
    estimates = [
        estimate(begin_ns + k * SECOND // RATE, 2.0 * k, accepted=k != 2) for k in range(9)
    ]
    for one in estimates:
        keeper.recorder.estimate(one)
    keeper.close()
    return record.folder, estimates, clocks["utc_ns"] - clocks["monotonic_ns"], cache


@pytest.mark.parametrize("b_frames", [0, 2])
def test_a_recording_gets_what_its_record_says_field_by_field(flown, tmp_path, b_frames):
    folder, estimates, utc_minus_monotonic, cache = flown
    stamps = [e.exposure_time_ns + utc_minus_monotonic for e in estimates]
    write_video(tmp_path / "in.ts", len(stamps), stamps, b_frames)
    out = tmp_path / "out.ts"
    written = describe_recording(tmp_path / "in.ts", folder, out, mission="survey 7")
    accepted = [k for k, e in enumerate(estimates) if e.accepted]
    assert (written.pictures, written.described) == (len(estimates), len(accepted))
    kinds, video, metadata = read_stream(str(out))
    assert [kind for kind, _ in kinds] == ["video", "data"]
    assert video == read_stream(str(tmp_path / "in.ts"))[1]
    assert len(metadata) == len(accepted)
    first = min(metadata)
    rows = dict(_rows(folder))
    for pts, packet in metadata.items():
        k = accepted[0] + round((pts - first) * RATE)
        fields = fields_of(packet)
        row = rows[estimates[k].exposure_time_ns]
        assert round(fields[2].timestamp() * 1e6) == stamps[k] // 1000
        assert fields[3] == "survey 7"
        assert fields[13] == pytest.approx(row["latitude_deg"], abs=3e-8)
        assert fields[14] == pytest.approx(row["longitude_deg"], abs=6e-8)
        geoid = cache.manifest.geoid_separation_m
        assert fields[15] == pytest.approx(row["height_m"] - geoid, abs=0.16)
        assert fields[21] == pytest.approx(row["height_m"] - fields[78], abs=0.5)  # looks down
    begun = describe_recording(tmp_path / "in.ts", folder, tmp_path / "b.ts", begin_s=1.2)
    assert begun.described == len([k for k in accepted if k >= 2])  # two pictures later


def _rows(folder):
    with (folder / "estimates.csv").open() as file:
        for row in csv.DictReader(file):
            names = ("latitude_deg", "longitude_deg", "height_m")
            yield int(row["exposure_time_ns"]), {name: float(row[name]) for name in names}


def test_a_raw_video_without_times_is_named(flown, tmp_path):
    folder, *_ = flown
    write_video(tmp_path / "in.ts", 3, [0, 0, 0])
    with av.open(str(tmp_path / "in.ts")) as source, av.open(str(tmp_path / "in.h264"), "w") as raw:
        stream = raw.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                raw.mux(packet)
    with pytest.raises(StreamOpenError, match="ffmpeg -r RATE"):
        describe_recording(tmp_path / "in.h264", folder, tmp_path / "out.ts", begin_s=0.0)
    # FFmpeg's end of file, which the command line took for the user's end of input: "Aborted."
    (tmp_path / "cut.ts").write_bytes((tmp_path / "in.ts").read_bytes()[:376])
    with pytest.raises(StreamOpenError, match="not a video"):
        describe_recording(tmp_path / "cut.ts", folder, tmp_path / "out.ts", begin_s=0.0)


def test_a_video_of_another_flight_is_told_and_leaves_no_file(flown, tmp_path):
    folder, estimates, offset, _ = flown
    write_video(
        tmp_path / "in.ts", 3, [e.exposure_time_ns + offset + SECOND * 99 for e in estimates]
    )
    for begin in (None, 5000.0):
        with pytest.raises(RecordError, match="--begin"):
            describe_recording(tmp_path / "in.ts", folder, tmp_path / "out.ts", begin_s=begin)
    assert not (tmp_path / "out.ts").exists()
    (folder / "record.json").write_text(json.dumps({}))
    with pytest.raises(RecordError):
        describe_recording(tmp_path / "in.ts", folder, tmp_path / "out.ts")
