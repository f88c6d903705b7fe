"""Telemetry in files beside photos and videos."""

import numpy as np
import pytest

from companion.errors import FootageError
from companion.recorded.flight import Datum, Track
from companion.recorded.photo_tags import read_places
from companion.recorded.video import read_subtitles


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# any comment\na.jpg 8.5 47.3 500 nan nan nan\n", Datum.AMSL),
        ("EPSG:4326\na.jpg 8.5 47.3 500\n", Datum.AMSL),
        ("\ufeffFilename;Latitude;Longitude;Altitude\r\na.jpg;47.3;8.5;500\r\n", Datum.AMSL),
        ("image,lon,lat,ellipsoidal_height\na.jpg,8.5,47.3,500\n", Datum.ELLIPSOID),
        ("name,lat,lon,relative_altitude\na.jpg,47.3,8.5,500\n", Datum.TAKEOFF),
    ],
)
def test_places_by_header_or_in_the_usual_order(tmp_path, text, expected):
    file = tmp_path / "places.csv"
    file.write_text(text, encoding="utf-8")
    position = read_places(file)["a.jpg"].position
    assert (position.latitude_deg, position.longitude_deg) == (47.3, 8.5)
    (height,) = position.heights
    assert (height.value_m, height.datum) == (500.0, expected)


def test_places_that_cannot_be_are_named(tmp_path):
    file = tmp_path / "places.txt"
    for text, why in (
        ("a.jpg 47.3 108.5 500\n", "longitude comes before latitude"),
        ("a.jpg here there\n", "expected a name"),
        ("\n", "holds no place"),
        (f'name,lat,lon\n"a.jpg{"x" * 200_000},47.3,8.5\n', "cannot be read: field larger"),
        ("a.jpg 8.5 47.3\na.jpg 8.5 47.4\n", r":2: a second line of a\.jpg"),
        ("name,lat,lon\na.jpg,149.2,-35.4\n", "are they swapped"),
        ("lat,lon,name\n47.48,8.13\n", "txt:2: expected a name"),
        ("name,lat,lon,timestamp\na.jpg,47.3,8.5,1e300\n", r"txt:2: time 1e\+300 is not"),
        *(
            (f"name,lat,lon,accuracy\na.jpg,47.3,8.5,{m}\n", "txt:2: accuracy .* is not from")
            for m in ("1e200", "1e30", "-3", "0")
        ),
        *(
            (f"name,lat,lon,gimbal_pitch\na.jpg,47.3,8.5,{deg}\n", "txt:2: pitch .* is not from")
            for deg in ("1e9", "95")
        ),
    ):
        file.write_text(text)
        with pytest.raises(FootageError, match=why):
            read_places(file)


_CUE = "{n}\n00:00:{s:02d},000 --> 00:00:{s:02d},033\n{body}\n\n"
_BRACKETS = (
    '<font size="28">SrtCnt : 1, DiffTime : 33ms\n2024-05-01 10:00:00.123\n[iso : 100] '
    "[focal_len : 24.00] [dzoom_ratio: 10000, delta:0] [latitude: 47.3] [{longitude}: 8.5] "
    "[rel_alt: 60.0 abs_alt: 512.5] [gb_yaw : 90.0 gb_pitch : -60.0 gb_roll : 0.0] </font>"
)


@pytest.mark.parametrize(
    ("body", "height"),
    [
        (_BRACKETS.format(longitude="longitude"), 60.0),
        (_BRACKETS.format(longitude="longtitude"), 60.0),
        ("F/2.8, SS 320, ISO 100, EV 0, GPS (8.5, 47.3, 19), D 24.6m, H 60.0m, H.S 4.8m/s", 60.0),
        ("HOME(8.4,47.2) 2017.08.05 14:11:51\nGPS(8.5,47.3,16) BAROMETER:60.0", 60.0),
        ("HOME(E: 8.4, N: 47.2)\nGPS(E: 8.5, N: 47.3, 60.0m)\nF.PRY (1, 2, 90), "
         "G.PRY (-60.0°, 0.0°, 90.0°)", 60.0),
    ],
    ids=["brackets", "misspelled", "mini", "mavic pro", "autel"],
)  # fmt: skip
def test_subtitles_of_each_kind(tmp_path, body, height):
    file = tmp_path / "a.SRT"
    text = "".join(_CUE.format(n=s + 1, s=s, body=body) for s in range(3))
    file.write_text(text, encoding="utf-8")
    found = read_subtitles(file)
    at = Track(found.samples, 5.0).at(1_500_000_000)
    assert (at.position.latitude_deg, at.position.longitude_deg) == (47.3, 8.5)
    takeoff = next(h for h in at.position.heights if h.datum is Datum.TAKEOFF)
    assert takeoff.value_m == height
    if "gb_" in body or "G.PRY" in body:
        axis = at.view.ned_from_camera[:, 2]
        np.testing.assert_allclose(axis, [0, 0.5, np.sqrt(0.75)], atol=1e-6)


@pytest.mark.parametrize("text", [_CUE.format(n=1, s=0, body="Good evening."), "", "\ufffd\x00"])
def test_subtitles_that_hold_no_position_are_named(tmp_path, text):
    file = tmp_path / "a.srt"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(FootageError, match="none with a position"):
        read_subtitles(file)


def test_positions_between_two_samples_move_on_and_gaps_stay_unknown(tmp_path):
    file = tmp_path / "a.srt"
    text = "".join(
        _CUE.format(n=s + 1, s=s, body=f"GPS (8.5, {47.3 + 0.001 * s}, 19), H 60.0m")
        for s in (0, 2, 20)
    )
    file.write_text(text)
    track = Track(read_subtitles(file).samples, 5.0)
    assert track.at(1_000_000_000).position.latitude_deg == pytest.approx(47.301)
    assert track.at(10_000_000_000) is None
    assert track.at(90_000_000_000) is None
