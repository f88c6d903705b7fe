"""Folders, photos and videos as people bring them."""

import json
import shutil
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from companion.errors import FootageError
from companion.klv import local_set as tag
from companion.recorded.footage import FootageOptions, read_footage
from companion.recorded.sequence import load_sequence, sequence_of
from localizer.errors import SequenceError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.trajectory import pose_row, write_poses
from tests.companion.recorded.logs import UTC_S, swaying, write_dataflash, write_tlog
from tests.companion.recorded.photos import dji, write_photo

_FOCAL_35 = 0xA405
_TAKEN = 0x9003


def _survey(folder, count=4, **more):
    folder.mkdir(exist_ok=True)
    for k in range(count):
        xmp = dji(GpsLatitude=47.3 + 1e-4 * k, GpsLongitude=8.5, RelativeAltitude="+60.0",
                  GimbalRollDegree="0.0", GimbalPitchDegree="-89.9", GimbalYawDegree="12.0",
                  **more)  # fmt: skip
        exif = {_FOCAL_35: 24, _TAKEN: f"2024:05:01 10:00:{2 * k:02d}"}
        write_photo(folder / f"DJI_{k:04d}.JPG", xmp, exif=exif)
    return folder


def write_video(path, seconds=4.0, klv=None, rates=(10, 10), size=(160, 120)):
    """Moving blocks; rates: frames a second in the first and the second half; klv: packets by
    time.
    """
    times, t = [], 0.0
    while t < seconds:
        times.append(t)
        t += 1.0 / rates[0 if t < seconds / 2 else 1]
    with av.open(str(path), "w", format="mpegts" if klv else None) as out:
        stream = out.add_stream("libx264", rate=10)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.options = {"bf": "0", "g": "5", "preset": "ultrafast"}
        data = out.add_mux_stream("klv", time_base=Fraction(1, 90_000)) if klv else None
        for at in times:
            for when, body in [x for x in klv or [] if x[0] <= at]:
                klv.remove((when, body))
                packet = av.Packet(body)
                packet.stream, packet.time_base = data, Fraction(1, 90_000)
                packet.pts = packet.dts = round(when * 90_000)
                out.mux(packet)
            image = np.full((size[1], size[0], 3), 60, np.uint8)
            image[20:60, round(20 * at) : round(20 * at) + 40] = 220
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = round(at * 1000), Fraction(1, 1000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def test_a_folder_of_photos_needs_nothing_else(tmp_path):
    flight = read_footage(_survey(tmp_path / "p"), FootageOptions(tmp_path / "w", frames=3))
    assert (flight.kind, len(flight.frames), flight.located_count) == ("photos", 3, 3)
    assert "3 of 4 photos are used" in flight.notes[0]
    assert flight.frames[0].telemetry.view.nadir_angle_deg < 1.0
    assert flight.camera.focal_percent == 2.0


def test_what_is_wrong_with_photos_is_named(tmp_path):
    options = FootageOptions(tmp_path / "w")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(FootageError, match="no photo and no video"):
        read_footage(empty, options)
    (empty / "DJI_0001.DNG").write_bytes(b"II*\0")
    with pytest.raises(FootageError, match="raw photos"):
        read_footage(empty, options)
    with pytest.raises(FootageError, match="raw photos are not read"):
        read_footage(empty / "DJI_0001.DNG", options)
    with pytest.raises(FootageError, match="no such file"):
        read_footage(tmp_path / "nowhere", options)
    write_tlog(tmp_path / "a.tlog", swaying, 1.0)
    for wrong, why in (
        ({"places": tmp_path / "a.tlog"}, "--places .*autopilot's log; give it as --log"),
        ({"log": empty / "DJI_0001.DNG"}, "--log .*no autopilot's log"),
        ({"log": tmp_path / "b.bin"}, "--log .*no such file"),
        ({"camera": empty}, "--camera .*is a folder; give the file"),
    ):
        with pytest.raises(FootageError, match=why):
            read_footage(empty, replace(options, **wrong))
    bare = tmp_path / "bare"
    bare.mkdir()
    write_photo(bare / "a.jpg")
    with pytest.raises(FootageError, match="focal length"):
        read_footage(bare, options)
    flight = read_footage(bare, FootageOptions(tmp_path / "w", fov_deg=70.0))
    assert "1 of 1 frames have no position" in flight.notes


def test_zero_angles_other_lenses_and_rotated_photos_are_told(tmp_path):
    folder = _survey(tmp_path / "p", FlightYawDegree="90.0")
    for k in range(4):
        zero = dji(GimbalRollDegree="+0.00", GimbalPitchDegree="+0.00", GimbalYawDegree="+0.00",
                   FlightYawDegree=k)  # fmt: skip
        write_photo(folder / f"Z_{k:04d}.JPG", zero, exif={_FOCAL_35: 24, 0x0112: 6})
    write_photo(folder / "thermal.jpg", exif={_FOCAL_35: 24}, size=(32, 24))
    notes = " ".join(read_footage(folder, FootageOptions(tmp_path / "w")).notes)
    assert "4 of 8 photos have gimbal angles that are exactly zero" in notes
    assert "1 photos of another camera or size are left out" in notes
    assert "4 photos are marked as rotated" in notes


def test_a_position_off_the_earth_is_named_and_left_out(tmp_path):
    """One such photo made the whole folder unreadable."""
    folder = _survey(tmp_path / "p")
    wrong = dji(GpsLatitude="124.0", GpsLongitude="8.5", FlightYawDegree="90.0")
    write_photo(folder / "DJI_0001.JPG", wrong, exif={_FOCAL_35: 24})
    flight = read_footage(folder, FootageOptions(tmp_path / "w"))
    assert (len(flight.frames), flight.located_count) == (4, 3)
    told = "1 photos lose their position, the first: DJI_0001.JPG: tags say latitude 124"
    assert told in " ".join(flight.notes)


def test_what_cannot_be_used_is_left_out_or_refused(tmp_path):
    folder = _survey(tmp_path / "p")
    (folder / "DJI_0001.JPG").write_bytes((folder / "DJI_0001.JPG").read_bytes()[:200])
    flight = read_footage(folder, FootageOptions(tmp_path / "w"))
    assert len(flight.frames) == 3
    assert "1 photos are left out, the first" in flight.notes[0]
    for photo in folder.iterdir():
        photo.write_bytes(b"no photo")
    with pytest.raises(FootageError, match="not an image that can be read"):
        read_footage(folder, FootageOptions(tmp_path / "w"))
    with pytest.raises(FootageError, match="give one of its folders: p"):
        read_footage(tmp_path, FootageOptions(tmp_path / "w"))
    with pytest.raises(FootageError, match="/dev/null: neither a photo"):
        read_footage(Path("/dev/null"), FootageOptions(tmp_path / "w"))


def test_a_repeated_photo_counts_once(tmp_path):
    """As evidence it says nothing new: 100 links to 8 photos made the sigmas a third."""
    folder = _survey(tmp_path / "p", 3)
    (folder / "again.JPG").symlink_to(folder / "DJI_0001.JPG")
    shutil.copy(folder / "DJI_0002.JPG", folder / "copy.JPG")
    flight = read_footage(folder, FootageOptions(tmp_path / "w"))
    assert len(flight.frames) == 3
    assert "2 photos repeat others byte by byte: left out" in flight.notes


def test_a_calibration_beside_the_photos_is_used_without_a_folding_lens(tmp_path):
    """A real one of OpenCV: K is good, k3 folds the corners."""
    folder = tmp_path / "set" / "photos"
    folder.mkdir(parents=True)
    write_photo(folder / "a.jpg", size=(164, 123))
    told = {"xresolution": 1640, "yresolution": 1232, "lens": 3.0,
            "K": [[1329.5, 0.0, 810.0], [0.0, 1329.3, 618.6], [0.0, 0.0, 1.0]],
            "D": [[0.166, -0.223, -0.0038, 0.0024, -0.608]]}  # fmt: skip
    file = tmp_path / "set" / "camera_picam.json"
    file.write_text(json.dumps(told))
    guess = read_footage(folder, FootageOptions(tmp_path / "w")).camera
    assert guess.camera.fx == pytest.approx(132.95, rel=1e-3)
    assert not guess.camera.is_distorted
    assert guess.source.startswith("camera_picam.json without its distortion")
    file.write_text(json.dumps(told | {"D": [[-1.7, 0.9, 0.0, 0.0, 0.0]]}))
    with pytest.raises(FootageError, match="give the field of view alone, as --fov"):
        read_footage(folder, FootageOptions(tmp_path / "w"))


def test_photos_that_another_program_turned_are_refused(tmp_path):
    folder = tmp_path / "p"
    folder.mkdir()
    exif = {_FOCAL_35: 24, 0xA002: 4000, 0xA003: 3000}
    write_photo(folder / "a.jpg", exif=exif, size=(30, 40))
    with pytest.raises(FootageError, match="another program turned its pixels"):
        read_footage(folder, FootageOptions(tmp_path / "w"))
    write_photo(folder / "a.jpg", exif=exif, size=(40, 30))
    (folder / "places.csv").write_text("name,lat,lon\na.jpg,0.0,0.0\n")
    flight = read_footage(folder, FootageOptions(tmp_path / "w"))
    assert flight.located_count == 0
    assert "1 of 1 frames have no position" in flight.notes


def test_several_files_of_places_are_asked_about(tmp_path):
    folder = _survey(tmp_path / "p")
    for name in ("a.csv", "b.csv"):
        (folder / name).write_text("name,lat,lon\nDJI_0000.JPG,47.0,8.0\n")
    with pytest.raises(FootageError, match=r"a\.csv, b\.csv; choose one by --places"):
        read_footage(folder, FootageOptions(tmp_path / "w"))
    flight = read_footage(folder, FootageOptions(tmp_path / "w", places=folder / "a.csv"))
    assert flight.frames[0].telemetry.position.latitude_deg == 47.0


def test_a_video_with_subtitles(tmp_path):
    video = write_video(tmp_path / "DJI_0001.MP4", rates=(10, 4))
    cues = "".join(
        f"{s + 1}\n00:00:0{s},000 --> 00:00:0{s},500\n[focal_len: 24] "
        f"[latitude: {47.3 + 1e-4 * s}] "
        "[longitude: 8.5] [rel_alt: 60.0 abs_alt: 500]\n\n"
        for s in range(5)
    )
    (tmp_path / "DJI_0001.SRT").write_text(cues)
    flight = read_footage(video, FootageOptions(tmp_path / "w", frames=4))
    assert flight.kind == "video"
    times = [(f.time_ns or 0) / 1e9 for f in flight.frames]
    assert times == pytest.approx([0.0, 1.0, 2.0, 3.0], abs=0.26)
    for frame in flight.frames:
        latitude = frame.telemetry.position.latitude_deg
        assert latitude == pytest.approx(47.3 + 1e-13 * (frame.time_ns or 0), abs=1e-7)


@pytest.mark.parametrize(
    ("day", "cues", "told"),
    [("2024-05-01", 20, ()), ("2024-05-02", 18, ()), ("2024-05-04", 20, ("another flight",)),
     ("2024-05-01", 40, ("cut?",)), ("2024-05-01", 9, ("cut?",)), ("2024-13-01", 20, ())],
)  # fmt: skip
def test_subtitles_of_another_video_are_named(tmp_path, day, cues, told):
    plain = write_video(tmp_path / "a.mp4", seconds=20.0)
    with av.open(str(plain)) as read, av.open(str(tmp_path / "b.mp4"), "w") as out:
        out.metadata["creation_time"] = "2024-05-01T10:00:00.000000Z"
        stream = out.add_stream_from_template(read.streams.video[0])
        for packet in read.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    (tmp_path / "b.srt").write_text("".join(
        f"{s + 1}\n00:00:{s:02d},000 --> 00:00:{s:02d},500\n{day} 10:00:{s:02d}.000\n"
        f"[focal_len: 24] [latitude: 47.3] [longitude: {8.5 + 1e-4 * s}] [rel_alt: 60.0]\n\n"
        for s in range(cues)
    ))  # fmt: skip
    flight = read_footage(tmp_path / "b.mp4", FootageOptions(tmp_path / "w", frames=4))
    for word in ("another flight", "cut?"):
        assert any(word in note for note in flight.notes) == (word in told), flight.notes


def test_a_log_of_a_flight_elsewhere_is_refused(tmp_path):
    """Its motion can look alike by chance: a real log of Australia was laid beside such a video."""
    folder = _survey(tmp_path / "p")
    elsewhere = (46.0, 8.5, 500.0)
    log = write_dataflash(tmp_path / "b.bin", swaying, 20.0, origin=elsewhere)
    places = tmp_path / "utc.csv"
    rows = "".join(f"DJI_{k:04d}.JPG,47.3,8.5,{UTC_S + 5 + k:.1f}\n" for k in range(4))
    places.write_text("name,lat,lon,utc\n" + rows)
    options = FootageOptions(tmp_path / "w", places=places, log=log)
    with pytest.raises(FootageError, match="144 km from where their own telemetry has them"):
        read_footage(folder, options)


def test_a_video_with_metadata_in_it(tmp_path):
    fields = {tag.SENSOR_LATITUDE: 47.3, tag.SENSOR_LONGITUDE: 8.5, tag.SENSOR_ALTITUDE: 560.0,
              tag.HORIZONTAL_FOV: 60.0, tag.PLATFORM_HEADING: 90.0, tag.PLATFORM_PITCH: 0.0,
              tag.PLATFORM_ROLL: 0.0, tag.RELATIVE_AZIMUTH: 0.0, tag.RELATIVE_ELEVATION: -60.0,
    }  # fmt: skip
    packets = [(0.1 * k, tag.encode(round(1e6 * (UTC_S + 0.1 * k)), fields)) for k in range(40)]
    packets[7] = (packets[7][0], packets[7][1][:-1] + b"\x00")
    video = write_video(tmp_path / "a.ts", klv=packets)
    flight = read_footage(video, FootageOptions(tmp_path / "w", frames=4))
    assert "1 of 40 KLV packets cannot be read" in flight.notes
    assert flight.camera.camera.horizontal_fov_deg == pytest.approx(60.0, abs=0.01)
    axis = flight.frames[2].telemetry.view.ned_from_camera[:, 2]
    np.testing.assert_allclose(axis, [0, 0.5, np.sqrt(0.75)], atol=1e-3)


def test_a_video_without_telemetry_or_with_anothers_is_named(tmp_path):
    video = write_video(tmp_path / "a.mp4")
    with pytest.raises(FootageError, match="focal length"):
        read_footage(video, FootageOptions(tmp_path / "w"))
    flight = read_footage(video, FootageOptions(tmp_path / "w", fov_deg=70.0))
    assert any("no telemetry" in note for note in flight.notes)
    write_tlog(tmp_path / "a.tlog", swaying, 20.0)
    with pytest.raises(FootageError, match="cannot be found by motion"):
        read_footage(video, FootageOptions(tmp_path / "w", fov_deg=70.0))
    (tmp_path / "b.mp4").write_bytes(video.read_bytes()[:200])
    with pytest.raises(FootageError, match="not a video, or damaged"):
        read_footage(tmp_path / "b.mp4", FootageOptions(tmp_path / "w", fov_deg=70.0))


def test_a_raw_video_is_read_at_the_rate_in_its_headers(tmp_path):
    """It holds no times and no length; FFmpeg guesses 25 a second."""
    with av.open(str(tmp_path / "a.h264"), "w") as out:
        stream = out.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for shade in range(40):
            image = np.full((120, 160, 3), 5 * shade, np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))
    flight = read_footage(tmp_path / "a.h264", FootageOptions(tmp_path / "w", fov_deg=70.0))
    assert [f.time_ns for f in flight.frames] == [500_000_000 * k for k in range(8)]
    assert any("no times in it: 10 frames a second, as its headers say" in n for n in flight.notes)


def test_djis_own_track_in_a_video_is_named(tmp_path):
    video = tmp_path / "DJI_0002.MP4"
    with av.open(str(video), "w") as out:
        stream = out.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        stream.metadata["timecode"] = "01:00:00:00"  # its track becomes DJI's below
        image = np.zeros((120, 160, 3), np.uint8)
        for _ in range(5):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))
    made = video.read_bytes().replace(b"mhlrtmcd", b"mhlrmeta")
    video.write_bytes(made.replace(b"TimeCodeHandler", b"DJI meta".ljust(15, b"\0")))
    flight = read_footage(video, FootageOptions(tmp_path / "w", fov_deg=70.0))
    assert any("telemetry inside DJI's video is not read: give its .SRT" in n for n in flight.notes)


def test_a_sequence_is_footage_and_photos_with_tags_are_a_sequence(tmp_path):
    """One form: what `eval` measures, `try` can try, and the other way round."""
    folder = _survey(tmp_path / "p", AbsoluteAltitude="+560.0")
    frame = LocalFrame(Geodetic(47.3, 8.5, 0.0))
    taken = sequence_of(read_footage(folder, FootageOptions(tmp_path / "w")), frame, 50.0)
    assert taken.truth[0].translation == pytest.approx([0.0, 0.0, 610.0], abs=1e-6)
    assert taken.is_timed
    made = tmp_path / "sequence"
    shutil.copytree(folder, made / "images")
    poses = zip(taken.images, taken.truth, strict=True)
    write_poses(made / "poses.txt", [pose_row(p.name, pose, frame) for p, pose in poses])
    (made / "camera.json").write_text(json.dumps(taken.camera.to_dict()))
    stamps = "".join(f"{p.name} {k + 7}\n" for k, p in enumerate(taken.images))
    (made / "images" / "timestamps.txt").write_text(stamps)
    flight = read_footage(made, FootageOptions(tmp_path / "w", frames=2, fov_deg=50.0))
    assert [f.time_ns for f in flight.frames] == [7, 10]
    assert flight.camera.camera.horizontal_fov_deg == pytest.approx(50.0)
    for one, other in zip(taken.truth, load_sequence(made, frame).truth, strict=True):
        assert one.distance_to(other) == pytest.approx((0.0, 0.0), abs=1e-3)
    above_takeoff = read_footage(_survey(tmp_path / "q"), FootageOptions(tmp_path / "w"))
    with pytest.raises(SequenceError, match="4 of 4 frames have no true pose"):
        sequence_of(above_takeoff, frame, 50.0)


def test_the_sample_of_the_tutorial_is_complete(tmp_path):
    sample = Path(__file__).parents[3] / "examples" / "footage"
    flight = read_footage(sample / "photos", FootageOptions(tmp_path / "w"))
    assert (len(flight.frames), flight.located_count, flight.notes) == (8, 8, ())
    assert all(f.telemetry.view is not None for f in flight.frames)
    assert (sample / "dsm.tif").is_file()
    assert (sample / "ortho.tif").is_file()
