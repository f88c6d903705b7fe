"""From made observations with known errors back to the errors, and to what cannot be known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from companion.calibrate import unknowns as u
from companion.calibrate.evidence import (
    OFFSETS_S,
    AutopilotWindow,
    CalibrationFrame,
    CalibrationProblem,
    changed_camera,
)
from companion.calibrate.flight import CalibrationResult, receiver_bias_m
from companion.calibrate.pictures import Parts
from companion.calibrate.proposal import (
    SettingChange,
    apply_changes,
    blind_spots,
    require_flown_with,
    setting_changes,
    write_changed,
)
from companion.calibrate.solve import ImageNormalEquations, images_covariance, solve
from companion.config import load_config
from companion.errors import ConfigError
from companion.geometry import GIMBAL_FROM_CAMERA
from localizer.geometry.camera import Camera
from localizer.geometry.geo import NED_FROM_ENU
from localizer.geometry.pose import Array, Pose, matrix_from_euler, so3_exp

TOLD = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (-0.09, 0.02, 0.0, 0.0, 0.0))
ERRORS = np.zeros(u.COUNT)
ERRORS[u.FOCAL], ERRORS[u.LATE] = 0.025, 0.12
ERRORS[u.MOUNT] = np.radians([2.0, -1.5, 1.0])
ERRORS[u.SHIFT], ERRORS[u.BEND] = (1.5, -2.0, 0.4), (0.01, -0.005, 0.0, 0.0)


def frames(rich: bool, count: int = 40, seed: int = 1) -> list[CalibrationFrame]:
    """A flight with turns, heights and gimbal angles, or straight ahead looking down."""
    rng = np.random.default_rng(seed)
    camera = changed_camera(TOLD, ERRORS)
    mount = so3_exp(ERRORS[u.MOUNT])
    made = []
    for k in range(count):
        t0 = 2.0 * k
        heading = 0.5 * np.sin(0.4 * k) if rich else 0.0
        rate = 0.25 * np.cos(0.7 * k) if rich else 0.0
        pitch = np.radians(-90.0 + (40.0 * ((k // 3) % 3) / 2 if rich else 0.0))
        height = 60.0 + (50.0 * ((k // 5) % 3) / 2 if rich else 0.0)
        speed = 8.0 * np.array([np.cos(heading), np.sin(heading), 0.0])
        place0 = np.array([8.0 * k, 20 * np.sin(0.3 * k) if rich else 0.0, height])
        camera_, body, place = [], [], []
        for offset in OFFSETS_S:
            yaw = heading + rate * offset
            up = NED_FROM_ENU.T
            body.append(up @ matrix_from_euler(0.05, 0.02, yaw))
            camera_.append(up @ matrix_from_euler(0.0, pitch, yaw))
            place.append(place0 + speed * offset)
        window = AutopilotWindow(np.array(camera_), np.array(body), np.array(place))
        i = np.argmin(np.abs(OFFSETS_S + ERRORS[u.LATE]))
        R = window.camera[i] @ mount @ GIMBAL_FROM_CAMERA @ so3_exp(rng.normal(0, 1e-3, 3))
        C = window.place[i] + ERRORS[u.SHIFT] + rng.normal(0, 0.05, 3)
        pixels = rng.uniform(20, (620, 460), (60, 2))
        rays = camera.rays(pixels) @ R.T
        ground = rng.uniform(0.0, 6.0, 60)
        points = C + rays * ((ground - C[2]) / rays[:, 2])[:, None]
        keep = rays[:, 2] < -0.2
        seen = pixels[keep] + rng.normal(0, 0.2, (int(keep.sum()), 2))
        parts = Parts(points[keep], seen, np.broadcast_to(np.eye(2), (int(keep.sum()), 2, 2)))
        pose = Pose(so3_exp(rng.normal(0, 0.01, 3)) @ R, C + rng.normal(0, 0.5, 3))
        made.append(CalibrationFrame(round(t0 * 1e9), pose, parts, window))
    return made


def found_of(sighted: list[CalibrationFrame]) -> CalibrationResult:
    solution = solve(CalibrationProblem(sighted, TOLD, np.eye(3), np.zeros(3)))
    return CalibrationResult(
        TOLD, np.eye(3), np.zeros(3), solution, solution.covariance, 1.0, solution.pixel_sigma,
        len(sighted), 1, (),
    )  # fmt: skip


@pytest.fixture(scope="module")
def rich() -> CalibrationResult:
    return found_of(frames(rich=True))


def test_drawn_errors_come_back_within_their_sigmas(rich: CalibrationResult):
    off = rich.shared - ERRORS
    assert abs(off[u.FOCAL]) < 0.003
    assert np.abs(off[u.MOUNT]).max() < np.radians(0.2)
    assert abs(off[u.LATE]) < 0.010
    assert np.abs(off[u.SHIFT]).max() < 0.3
    assert np.abs(off / rich.sigmas).max() < 4.0


def test_what_a_flight_straight_ahead_cannot_tell_is_said(rich: CalibrationResult):
    flat = found_of(frames(rich=False))
    assert blind_spots(rich) == () or not any("focal" in line for line in blind_spots(rich))
    told = " ".join(blind_spots(flat))
    assert "mounting" in told  # and heading are the same thing, seen straight from above
    assert "heading" in told
    assert flat.sigmas[u.MOUNT].max() > 5 * rich.sigmas[u.MOUNT].max()


def test_a_flight_without_places_tells_optics_and_mounting_only():
    blind = [
        CalibrationFrame(
            f.time_ns,
            f.pose,
            f.parts,
            AutopilotWindow(f.window.camera, f.window.body, f.window.place * np.nan),
        )
        for f in frames(rich=True)
    ]
    found = found_of(blind)
    assert abs(found.shared[u.FOCAL] - ERRORS[u.FOCAL]) < 0.004
    assert found.sigmas[u.SHIFT].min() > 5.0
    assert "map east of GNSS" in " ".join(blind_spots(found))


def deployment(folder: Path) -> Path:
    path = folder / "deployment.yaml"
    document = {
        "map": str(folder), "camera": {"source": "udp://0.0.0.0:5600", "model": TOLD.to_dict()},
        "bridge": {"connection": "udpin:127.0.0.1:14550", "camera": {"mount_pitch_deg": 0.0}},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(document))
    return path


def test_the_deployment_is_changed_and_the_old_one_kept(rich: CalibrationResult, tmp_path: Path):
    path = deployment(tmp_path)
    before = path.read_text()
    wanted = setting_changes(load_config(path), rich)
    kept = write_changed(path, wanted, "calibrated")
    assert kept.read_text() == before
    after = load_config(path)
    assert after.camera.model.fx == pytest.approx(500.0 * np.exp(0.025), rel=0.003)
    assert after.camera.settings.time_offset_ms == pytest.approx(120.0, abs=10.0)
    assert after.bridge.camera.mount_pitch_deg == pytest.approx(-1.5, abs=0.2)
    assert after.camera.calibrated is not None
    dated = after.camera.model_copy(update={"calibrated": None})
    assert after.model_copy(update={"camera": dated}) == apply_changes(load_config(kept), wanted)
    assert write_changed(path, wanted, "again") != kept
    json.dumps({".".join(c.key): [c.before, c.after] for c in wanted})


def test_a_deployment_that_nobody_else_may_read_stays_so(tmp_path: Path):
    """Feeds and keys have their passwords in it."""
    path = deployment(tmp_path)
    path.chmod(0o600)
    kept = write_changed(path, (), "calibrated")
    assert [p.stat().st_mode & 0o777 for p in (path, kept)] == [0o600, 0o600]


def test_what_makes_no_deployment_is_not_written(tmp_path: Path):
    """A flight that tells little may say a lens that the next start would refuse."""
    path = deployment(tmp_path)
    before = path.read_text()
    wanted = (SettingChange(("camera", "model", "cx"), 320.0, 6000.0),)
    with pytest.raises(ConfigError, match=r"nothing was changed.*(\n.*)*cx 6000 is far"):
        write_changed(path, wanted, "calibrated")
    assert path.read_text() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["deployment.yaml"]


def test_another_flights_deployment_is_not_written_over(rich: CalibrationResult, tmp_path: Path):
    path = deployment(tmp_path)
    wanted = setting_changes(load_config(path), rich)
    require_flown_with(path, wanted)
    write_changed(path, wanted, "calibrated")
    require_flown_with(path, wanted)  # the same flight again
    remounted = (SettingChange(("bridge", "camera", "mount_pitch_deg"), None, -8.0),)
    write_changed(path, remounted, "mounted anew")
    with pytest.raises(ConfigError, match=r"mount_pitch_deg is -8.0, .* flown with 0.0"):
        require_flown_with(path, wanted)


# --- What a calibration says of the receiver under whose places it was made ---------------------


def test_a_receivers_error_is_of_the_whole_flight_and_not_of_its_last_picture() -> None:
    """It said 3 m for two minutes and 0.6 m at the end: the last alone is 5 times too sure."""
    assert receiver_bias_m([3.0] * 120 + [0.6]) == pytest.approx(2.98, abs=0.01)
    assert receiver_bias_m([0.6] * 120 + [3.0]) == pytest.approx(0.62, abs=0.01)


def test_a_receiver_that_says_little_or_nothing_is_not_believed_to_be_perfect() -> None:
    assert receiver_bias_m([]) == receiver_bias_m([None, 0.01]) == 0.5


# --- Pictures of the same ground err alike: a hundred of ten places are no hundred --------------


PICTURES, PLACES = 240, 24


def larger(pulls: Array, grounds: Array) -> float:
    """Of one number that each picture tells with information 1, whatever its pose."""
    K = len(pulls)
    normals = ImageNormalEquations(
        np.tile(np.eye(6), (K, 1, 1)), np.zeros((K, 6, 1)), np.ones((K, 1, 1)), np.zeros((K, 6)),
        pulls[:, None],
    )  # fmt: skip
    gain = np.zeros((1, 1 + 6 * K))
    gain[0, 0] = 1.0 / K
    alone, factor = images_covariance(gain, 1, normals, grounds)
    assert alone[0, 0] == pytest.approx(1.0 / K)
    return float(factor[0])


def places(rng: np.random.Generator) -> tuple[NDArray[np.intp], Array]:
    """Each picture's place, and what it shows, m: ten of each place, legs apart in time."""
    of: NDArray[np.intp] = np.arange(PICTURES) % PLACES
    middles = np.stack([300.0 * (np.arange(PLACES) % 5), 300.0 * (np.arange(PLACES) // 5)], axis=1)
    return of, middles[of] + rng.uniform(-5.0, 5.0, (PICTURES, 2))


def test_pictures_that_err_for_themselves_are_believed():
    rng = np.random.default_rng(1)
    _, grounds = places(rng)
    pulls = rng.normal(0.0, 1.0, PICTURES)
    assert larger(pulls - pulls.mean(), grounds) < 1.35


def test_those_of_the_same_ground_that_err_alike_count_once_whenever_they_were_taken():
    rng = np.random.default_rng(2)
    of, grounds = places(rng)
    pulls = rng.normal(0.0, 1.0, PLACES)[of]
    factor = larger(pulls - pulls.mean(), grounds)
    assert factor == pytest.approx(np.sqrt(PICTURES / PLACES), rel=0.35)
