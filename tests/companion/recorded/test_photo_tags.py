"""Photos' tags of several makers, as one form."""

import numpy as np
import pytest

from companion.config import of_stream_size
from companion.errors import FootageError
from companion.recorded.cameras import camera_of_tags
from companion.recorded.flight import Datum
from companion.recorded.photo_tags import PhotoTags, looking_down, read_photo_tags
from tests.companion.recorded.photos import dji, elements, write_photo

_FOCAL, _FOCAL_35, _MAKE, _MODEL = 0x920A, 0xA405, 0x010F, 0x0110


def _looks(path):
    """North, east, down of the optical axis, and of the image's top."""
    R = read_photo_tags(path).view().ned_from_camera
    return R[:, 2], -R[:, 1]


@pytest.mark.parametrize(
    "xmp",
    [
        dji(GimbalRollDegree="+0.00", GimbalPitchDegree="-60.00", GimbalYawDegree="+90.00"),
        elements(
            "<skydio:CameraOrientationNED><skydio:Pitch>-60</skydio:Pitch><skydio:Roll>0"
            "</skydio:Roll><skydio:Yaw>90</skydio:Yaw></skydio:CameraOrientationNED>"
        ),
        elements(
            "<a:CameraRollDegree>0</a:CameraRollDegree><a:CameraPitchDegree>-60"
            "</a:CameraPitchDegree><a:CameraYawDegree>90</a:CameraYawDegree>"
        ),
        elements("<Camera:Yaw>90</Camera:Yaw><Camera:Pitch>30</Camera:Pitch><Camera:Roll>0</Camera:Roll>"),
    ],
    ids=["dji", "skydio", "parrot", "pix4d: autel, sensefly"],
)  # fmt: skip
def test_makers_angles_mean_the_same_view(tmp_path, xmp):
    axis, top = _looks(write_photo(tmp_path / "a.jpg", xmp))
    np.testing.assert_allclose(axis, [0, 0.5, np.sqrt(0.75)], atol=1e-6)
    np.testing.assert_allclose(top, [0, np.sqrt(0.75), -0.5], atol=1e-6)


def test_angles_that_are_exactly_zero_are_not_measured(tmp_path):
    zero = dji(GimbalRollDegree="+0.00", GimbalPitchDegree="+0.00", GimbalYawDegree="+0.00",
               FlightYawDegree="+152.10")  # fmt: skip
    tags = read_photo_tags(write_photo(tmp_path / "a.jpg", zero))
    assert tags.view() is None
    assert tags.has_zero_view
    assert tags.telemetry().course_deg == 152.1
    level = dji(GimbalRollDegree="+0.00", GimbalPitchDegree="+0.00", GimbalYawDegree="+12.00")
    assert read_photo_tags(write_photo(tmp_path / "b.jpg", level)).view() is not None


def test_the_assumed_view_looks_down_with_the_top_ahead():
    view = looking_down(90.0)
    assert not view.measured
    np.testing.assert_allclose(view.ned_from_camera[:, 2], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(-view.ned_from_camera[:, 1], [0, 1, 0], atol=1e-9)
    assert looking_down(None).heading_sigma_deg is None


def test_heights_keep_what_they_are_above(tmp_path):
    plain = dji(AbsoluteAltitude="+375.62", RelativeAltitude="+119.70")
    fixed = dji(AbsoluteAltitude="+567.50", AltitudeType="RtkAlt", RtkFlag="50")

    def heights(name, xmp):
        photo = write_photo(tmp_path / name, xmp, place=(-24.25, 120.5, 1.0))
        return {h.datum: h for h in read_photo_tags(photo).telemetry().position.heights}

    found = heights("a.jpg", plain)
    assert found[Datum.TAKEOFF].value_m == 119.7
    assert found[Datum.AMSL].value_m == 375.62
    assert found[Datum.TAKEOFF].sigma_m < 5.0 < found[Datum.AMSL].sigma_m
    assert heights("b.jpg", fixed) == {Datum.ELLIPSOID: found_rtk(heights("b.jpg", fixed))}
    assert heights("c.jpg", "")[Datum.AMSL].value_m == 1.0


def found_rtk(heights):
    (height,) = heights.values()
    assert height.value_m == 567.5
    assert height.sigma_m < 1.0
    return height


def test_a_position_that_is_no_place_is_named_and_none_is_none(tmp_path):
    photo = write_photo(tmp_path / "a.jpg", place=(-24.25, -120.5, 1.0))
    position = read_photo_tags(photo).telemetry().position
    assert position.latitude_deg == pytest.approx(-24.25)
    assert position.longitude_deg == pytest.approx(-120.5)
    assert read_photo_tags(write_photo(tmp_path / "b.jpg")).telemetry().position is None
    zero = write_photo(tmp_path / "c.jpg", dji(GpsLatitude="0.0", GpsLongitude="0.0"))
    assert read_photo_tags(zero).telemetry().position is None
    for tag in ("GPSXYAccuracy", "RtkStdLat"):
        for told in ("-1", "0", "1e300", "nan"):
            xmp = dji(GpsLatitude="47.0", GpsLongitude="8.0", **{tag: told})
            position = read_photo_tags(write_photo(tmp_path / "f.jpg", xmp)).telemetry().position
            assert position.sigma_m == 3.0
    wrong = write_photo(tmp_path / "d.jpg", dji(GpsLatitude="124.0", GpsLongitude="8.0"))
    assert "latitude 124, longitude 8: no place on Earth" in (
        read_photo_tags(wrong).wrong_place or ""
    )
    assert read_photo_tags(wrong).telemetry().position is None
    (tmp_path / "e.jpg").write_bytes(b"\xff\xd8 cut off")
    with pytest.raises(FootageError, match="not an image"):
        read_photo_tags(tmp_path / "e.jpg")
    data = photo.read_bytes()
    size = data.index(b"\xff\xc0") + 5  # in the start of the frame: an orthophoto's 65500x65500
    photo.write_bytes(data[:size] + b"\xff\xdc\xff\xdc" + data[size + 4 :])
    with pytest.raises(FootageError, match="not an image that can be read: Image size"):
        read_photo_tags(photo)


def test_the_focal_length_by_the_best_tag(tmp_path):
    # 16:9 cut out of a 4:3 sensor keeps its width: the equivalent is of the whole diagonal.
    wide = write_photo(tmp_path / "a.jpg", exif={_FOCAL: 4.49, _FOCAL_35: 24}, size=(400, 225))
    guess = camera_of_tags(read_photo_tags(wide))
    assert guess.camera.fx == pytest.approx(24 * 500 / 43.267, rel=1e-4)
    known = write_photo(tmp_path / "b.jpg", dji(CalibratedFocalLength="300.5"), size=(400, 300))
    assert camera_of_tags(read_photo_tags(known)).camera.fx == pytest.approx(300.5)
    dewarp = dji(DewarpData="2021-01-01;310,311,-2,3,-0.1,0.02,0.001,-0.001,0.01")
    camera = camera_of_tags(
        read_photo_tags(write_photo(tmp_path / "c.jpg", dewarp, size=(400, 300)))
    ).camera
    assert (camera.fx, camera.cx, camera.distortion[0]) == (310.0, 198.0, -0.1)
    spoilt = dji(DewarpData="a;nan,311,-2,3,0,0,0,0,0", CalibratedFocalLength="300.5")
    damaged = read_photo_tags(write_photo(tmp_path / "f.jpg", spoilt, size=(400, 300)))
    assert camera_of_tags(damaged).camera.fx == pytest.approx(300.5)
    for lens in ("9e9,9e9,0,0,0,0,0,0,0", "300,300,9e9,0,0,0,0,0,0", "300,300,0,0,-5,0,0,0,0"):
        spoilt = dji(DewarpData=f"a;{lens}", CalibratedFocalLength="300.5")
        impossible = read_photo_tags(write_photo(tmp_path / "g.jpg", spoilt, size=(400, 300)))
        assert camera_of_tags(impossible).camera.fx == pytest.approx(300.5)
    large = PhotoTags(tmp_path, 9504, 6336, {"FocalLengthIn35mmFilm": 35})
    camera = camera_of_tags(large).camera
    assert camera.width == 9504
    assert of_stream_size(camera).width == 8192
    sensor = write_photo(tmp_path / "d.jpg", exif={_MODEL: "FC6310", _FOCAL: 8.8}, size=(400, 300))
    assert camera_of_tags(read_photo_tags(sensor)).camera.fx == pytest.approx(8.8 / 13.2 * 400)
    with pytest.raises(FootageError, match="--camera FILE"):
        camera_of_tags(read_photo_tags(write_photo(tmp_path / "e.jpg")))
