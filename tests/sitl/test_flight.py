"""The product's main job, end to end, on a small world: every process, real video, real MAVLink."""

import json

import pytest

from sitl.assets import prepare
from sitl.flight import fly
from sitl.report import make_report, print_report
from sitl.scenario import CameraSpec, Leg, Scenario

SCENARIO = Scenario(
    takeoff_height_m=100,
    deny_after_s=5,
    legs=(
        Leg(east_m=0, north_m=70, height_m=100, gimbal_pitch_deg=-80),
        Leg(east_m=60, north_m=40, height_m=105, gimbal_pitch_deg=-70),
        Leg(east_m=0, north_m=0, height_m=100, gimbal_pitch_deg=-85),
    ),
    cars=6,
    people=5,
    camera=CameraSpec(rate_hz=8),
)


@pytest.fixture(scope="module")
def assets(tmp_path_factory):
    return prepare(3, tmp_path_factory.mktemp("worlds"), size_m=800.0)


@pytest.mark.parametrize("kind", ["embedded", pytest.param("ardupilot", marks=pytest.mark.sitl)])
def test_a_short_flight_without_gnss_comes_home(assets, tmp_path, kind):
    folder = tmp_path / "report"
    record = fly(assets, SCENARIO, kind, 3, folder)
    report = make_report(record, SCENARIO, 3)
    print_report(report, folder)
    assert report.vehicle == kind
    assert report.localizer.completeness > 90
    assert report.localizer.median_translation_m < 2.0
    assert report.ekf_horizontal_m.p95 < 6.0
    assert report.home_error_m < 6.0
    assert report.fixed_targets_m.median < 5.0
    written = json.loads((folder / "report.json").read_text())
    assert written["report"]["frames_sent"] == report.frames_sent > 100
    for name in ("tracks.png", "errors.png", "frames_report.csv", "overlay-0.png"):
        assert (folder / name).stat().st_size > 0
