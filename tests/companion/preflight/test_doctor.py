"""The companion's own checks of a deployment; the flight controller's are the bridge's."""

import re
import sys

import cv2
import numpy as np
import pytest
from rich.console import Console

from companion.cli.doctor import print_diagnosis
from companion.config import CameraModel, parse_config
from companion.preflight.doctor import examine_deployment
from companion.sources import StreamState
from localizer.types import Frame
from mavlink_bridge.preflight.doctor import Diagnosis
from mavlink_bridge.preflight.rules import DoctorFinding

SIZE = (160, 120)
MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}


@pytest.fixture
def map_cache(small_assets):
    return small_assets.map_cache


@pytest.fixture
def feed(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(12):
        image = np.full((SIZE[1], SIZE[0], 3), 10 * i, np.uint8)
        cv2.imwrite(str(folder / f"{i}.png"), image)
    return folder


def _findings(map_cache, source, model=MODEL, rate_hz=20.0, **settings):
    camera = {"source": str(source), "model": model, "settings": {"rate_hz": rate_hz}}
    config = parse_config({"map": str(map_cache), "camera": camera} | settings, "test")
    return {f.name: f for f in examine_deployment(config, vehicle=False).findings}


def test_a_good_deployment(map_cache, feed):
    findings = _findings(map_cache, feed)
    assert set(findings) == {
        "map", "map's kind", "map's imagery", "localizer", "camera", "power mode",
    }  # fmt: skip
    assert all(findings[name].ok for name in ("map", "localizer", "camera"))
    assert re.match(r"tiny \((onnxruntime|OpenVINO), CPU", findings["localizer"].found)
    assert "numba" in findings["localizer"].found
    assert findings["camera"].found == "160x120, 20.0 Hz"
    assert "tiles" in findings["map"].found
    imagery = findings["map's imagery"]
    assert (imagery.found, imagery.ok, imagery.required) == ("date not known", False, False)


def test_a_scaled_feed_is_advice_and_a_slow_or_cropped_one_is_wrong(map_cache, feed):
    double = {k: 2 * v for k, v in MODEL.items()}
    scaled = _findings(map_cache, feed, double)["camera"]
    assert (scaled.ok, scaled.required) == (False, False)
    assert "320x240" in scaled.needed
    cropped = _findings(map_cache, feed, double | {"height": 180})["camera"]
    assert (cropped.ok, cropped.required) == (False, True)
    assert "160x120" in cropped.why
    slow = _findings(map_cache, feed, rate_hz=4.0)["camera"]
    assert (slow.ok, slow.required) == (False, True)


def test_what_is_missing_is_named(tmp_path, feed):
    findings = _findings(tmp_path / "no-map", tmp_path / "no-feed.mp4")
    for name in ("map", "camera"):
        assert (findings[name].ok, findings[name].required) == (False, True)
        assert f"no-{'map' if name == 'map' else 'feed.mp4'}" in findings[name].why


@pytest.mark.parametrize(
    ("localizer", "why"),
    [
        ({"model": "no.onnx"}, "no.onnx: no such model file"),
        ({"renderer": "pyrender"}, "pyrender is not installed"),
    ],
)
def test_a_localizer_that_a_flight_could_not_make_is_wrong(
    map_cache, feed, monkeypatch, localizer, why
):
    monkeypatch.setitem(sys.modules, "localizer.render.pyrender_offscreen", None)  # not installed
    findings = _findings(map_cache, feed, localizer=localizer)
    assert (findings["localizer"].ok, findings["localizer"].required) == (False, True)
    assert why in findings["localizer"].why


def test_a_feed_that_delivers_is_left_after_three_seconds_of_pictures(map_cache, feed, monkeypatch):
    """A live feed never ends: it was read for eight seconds, however good it was."""
    taken = []

    class Endless:
        def frames(self):
            for i in range(10_000):
                taken.append(i)
                image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
                yield Frame(image, i * 50_000_000, CameraModel(**MODEL).camera(), i)

        def close(self):
            pass

    monkeypatch.setattr("companion.preflight.doctor.open_source", lambda *_: Endless())
    finding = _findings(map_cache, feed)["camera"]
    assert (finding.ok, finding.found) == (True, "160x120, 20.0 Hz")
    assert len(taken) == 62


def test_a_feed_whose_port_another_has_is_not_called_a_camera_that_is_off(map_cache, monkeypatch):
    class Taken:
        def __init__(self, *given):
            self.tell = given[3]

        def frames(self):
            self.tell(StreamState.STALLED, "udp://127.0.0.1:5600: cannot connect: Address in use")
            return iter(())

        def close(self):
            pass

    monkeypatch.setattr("companion.preflight.doctor.open_source", Taken)
    finding = _findings(map_cache, "udp://127.0.0.1:5600")["camera"]
    assert (finding.ok, finding.found) == (False, "silent")
    assert finding.why.endswith("in 8 s: cannot connect: Address in use")


def test_the_table_fits_a_terminal_of_80_columns_and_reasons_come_last(capsys):
    why = "no position by vision on 40 % of the way: build a larger map or move it"
    found = (
        DoctorFinding("localizer", "tiny (onnxruntime, CPU); numba", "a net", "", True, True),
        DoctorFinding(
            "GIMBAL_[MANAGER]_X", "silent", "GIMBAL_DEVICE_ATTITUDE_STATUS", why, False, True
        ),
    )
    print_diagnosis(Console(width=80, force_terminal=False), Diagnosis(found))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "NOT fit to fly" in lines[0]
    shown = " ".join(" ".join(lines).split())
    assert "GIMBAL_DEVICE_ATTITUDE_STATUS" in shown.replace(" ", "")
    assert shown.endswith(f"wrong GIMBAL_[MANAGER]_X: {why}")


def test_what_was_not_examined_is_said_beside_fit_to_fly(capsys):
    good = Diagnosis((DoctorFinding("map", "42 tiles", "a tile cache", "", True, True),))
    print_diagnosis(Console(width=80, force_terminal=False), good, ["vehicle"])
    lines = capsys.readouterr().out.splitlines()
    assert "fit to fly as far as examined" in lines[0]
    assert lines[-1].strip() == "vehicle: not examined"


def test_a_detection_network_that_a_flight_would_not_start_with_is_told(tmp_path):
    (tmp_path / "detector.onnx").write_text("no network")
    detector = {"detector": {"model": str(tmp_path / "detector.onnx")}}
    told = _findings("none", tmp_path / "none", targets=detector)["detector"]
    assert (told.ok, told.required) == (False, True)
    assert "detector.onnx: no ONNX network" in told.why
