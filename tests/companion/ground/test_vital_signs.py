"""The figures for a station's plots: right values, nothing invented, nothing after a loss."""

import json
import threading
from xml.etree import ElementTree

import numpy as np
import pytest

from companion.flight.recorder import TARGET_COLUMNS
from companion.ground.target_files import write_target_files
from companion.ground.vital_signs import VitalSigns
from localizer.types import TrackingState
from tests.companion.estimates import estimated

SECOND = 10**9


def estimate(time_ns, *, accepted=True, state=TrackingState.TRACKING, sigma=0.3):
    covariance = np.diag([sigma**2, sigma**2, 1.0, 0.0, 0.0, 0.0])
    said = {"covariance": covariance, "quality": 0.8, "state": state, "accepted": accepted}
    return estimated(time_ns=time_ns, **said)


def test_what_a_good_flight_says():
    signs = VitalSigns(lambda _: None)
    for k in range(60):
        signs.add_estimate(estimate(k * SECOND // 10, accepted=k % 2 == 0))
    told = signs.figures(6 * SECOND)
    assert told["VPS_SIGNAL"] == 2.0
    assert told["VPS_RATE"] == pytest.approx(5.0, abs=0.21)
    assert told["VPS_AGE"] == pytest.approx(0.2)
    assert told["VPS_SIGMA"] == pytest.approx(0.3 * np.sqrt(2))
    assert told["VPS_QUAL"] == pytest.approx(0.8)
    assert all(len(name) <= 10 for name in told)


@pytest.mark.parametrize(
    ("state", "age_s", "signal"),
    [
        (TrackingState.BRIDGING, 0.1, 1.0),
        (TrackingState.INITIALIZING, 0.1, 1.0),
        (TrackingState.TRACKING, 2.5, 0.0),
        (TrackingState.LOST, 0.1, 0.0),
    ],
)
def test_a_signal_is_claimed_only_of_what_is_fresh_and_sure(state, age_s, signal):
    signs = VitalSigns(lambda _: None)
    signs.add_estimate(estimate(SECOND))
    signs.add_estimate(estimate(SECOND + 1, accepted=False, state=state))
    assert signs.figures(round((1 + age_s) * SECOND))["VPS_SIGNAL"] == signal


def test_before_the_first_position_nothing_is_invented():
    signs = VitalSigns(lambda _: None)
    signs.add_estimate(estimate(SECOND, accepted=False, state=TrackingState.INITIALIZING))
    assert signs.figures(2 * SECOND) == {"VPS_SIGNAL": 0.0, "VPS_RATE": 0.0}


def test_a_bridge_that_refuses_does_not_end_the_telling(monkeypatch):
    monkeypatch.setattr("companion.ground.vital_signs._PERIOD_S", 0.01)
    told, again = [], threading.Event()

    def tell(figures):
        told.append(figures)
        if len(told) == 1:
            raise OSError("link")
        again.set()

    signs = VitalSigns(tell)
    signs.start()
    assert again.wait(30.0)
    signs.stop()


# --- The targets of a record as GeoJSON and KML, as a reader finds them -------------------------


KML = "{http://www.opengis.net/kml/2.2}"


def _row(name, time_ns, longitude=8.5, latitude=47.4, velocity=None, **changes):
    row = dict.fromkeys(TARGET_COLUMNS, "") | {
        "exposure_time_ns": str(time_ns), "target_id": name, "longitude_deg": f"{longitude:.9f}",
        "latitude_deg": f"{latitude:.9f}", "height_m": "450.25", "sigma_horizontal_m": "0.512",
        "sigma_up_m": "0.300", "elsewhere": "0.125", "visibility": "seen",
    }  # fmt: skip
    if velocity is not None:
        row |= {"velocity_east": str(velocity[0]), "velocity_north": str(velocity[1])}
    return ",".join((row | changes)[name] for name in TARGET_COLUMNS)


def _record(folder, rows):
    text = "\n".join([",".join(TARGET_COLUMNS), *rows]) + "\n"
    (folder / "targets.csv").write_text(text, encoding="utf-8")
    clocks = {"monotonic_ns": 10**9, "utc_ns": 1_790_000_001 * 10**9}
    (folder / "record.json").write_text(json.dumps(clocks))


def test_the_newest_place_of_each_target_and_the_line_of_one_that_moved(tmp_path):
    rows = [_row("ground station 1", 10**9 + k * 10**8, 8.5 + 1e-6 * k) for k in range(5)]
    rows += [_row("car é<", k * 10**9, 8.6 + 1e-4 * k, velocity=(3.0, 4.0)) for k in range(4)]
    _record(tmp_path, rows)
    assert write_target_files(tmp_path) == 2
    document = json.loads((tmp_path / "targets.geojson").read_text(encoding="utf-8"))
    house, car = document["features"]
    assert house["geometry"] == {"type": "Point", "coordinates": [8.500004, 47.4, 450.25]}
    assert house["properties"] == {
        "name": "ground station 1", "reports": 5, "first_seen": "2026-09-21T14:13:21.000Z",
        "last_seen": "2026-09-21T14:13:21.400Z", "sigma_horizontal_m": 0.512, "sigma_up_m": 0.3,
        "elsewhere": 0.125, "speed_mps": None, "course_deg": None,
    }  # fmt: skip
    point, line = car["geometry"]["geometries"]
    assert point["coordinates"] == pytest.approx([8.6003, 47.4, 450.25])
    assert len(line["coordinates"]) == 4
    assert (car["properties"]["speed_mps"], car["properties"]["course_deg"]) == (5.0, 36.9)
    root = ElementTree.parse(tmp_path / "targets.kml").getroot()
    names = [mark.findtext(f"{KML}name") for mark in root.iter(f"{KML}Placemark")]
    assert names == ["ground station 1", "car é<"]
    (line_text,) = [e.findtext(f"{KML}coordinates") for e in root.iter(f"{KML}LineString")]
    assert len(line_text.split()) == 4


def test_a_cut_or_senseless_row_is_left_out_and_a_record_without_targets_gets_no_files(tmp_path):
    good = _row("a", 10**9)
    _record(tmp_path, [good, _row("a", 2 * 10**9, height_m="nan"), good[:40], "\0,"])
    assert write_target_files(tmp_path) == 1
    assert json.loads((tmp_path / "targets.geojson").read_text())["features"][0]["id"] == "a"
    empty = tmp_path / "empty"
    empty.mkdir()
    _record(empty, [])
    assert write_target_files(empty) == 0
    assert not (empty / "targets.kml").exists()
