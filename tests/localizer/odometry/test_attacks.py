"""Images that show little of the ground, or something that does not move with it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.odometry.estimate import OdometryFrame
from localizer.odometry.ground import FlatGround
from localizer.odometry.odometry import VisualOdometry
from localizer.odometry.usability import find_fault
from localizer.registration.jngo import JNGO
from localizer.registration.priors import attitude_constraint, combine, height_constraint
from localizer.tracking import motion
from localizer.types import Image, PosePrior
from sitl.camera.faults import PictureFault, VideoFaultInjector, darken
from tests.localizer.registration.conftest import camera_pose

CAMERA, WORKING = Camera.from_fov(480, 360, 65.0), Camera.from_fov(256, 192, 65.0)
HEIGHT_M, SPEED_M_S, STEP_NS, FRAMES = 100.0, 8.0, 125_000_000, 16
METRES_A_PIXEL = HEIGHT_M / CAMERA.fx
BEGUN = np.diag([0.3, 0.3, 0.3, 5e-3, 5e-3, 5e-3]) ** 2

Spoil = Callable[[Image, int, np.random.Generator], Image]


def pose(k: int) -> Pose:
    return camera_pose(np.array([0.0, SPEED_M_S * k * STEP_NS * 1e-9, HEIGHT_M]), 90.0, 0.0)


@pytest.fixture(scope="module")
def ground() -> Image:
    """Grey texture on all scales, larger than the flight's views."""
    rng = np.random.default_rng(3)
    height, width = 480, CAMERA.width
    total = np.zeros((height, width), np.float32)
    for cells in (6, 14, 30, 60, 120, 240):
        field = rng.standard_normal((round(cells * height / width), cells)).astype(np.float32)
        total += cv2.resize(field, (width, height), interpolation=cv2.INTER_CUBIC)
    grey = np.clip(110 + 18 * total, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def view(ground: Image, k: int) -> Image:
    """What the camera sees of level ground at step k; ahead is up."""
    rows = len(ground) - CAMERA.height - SPEED_M_S * k * STEP_NS * 1e-9 / METRES_A_PIXEL
    shift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, rows]])
    size = (CAMERA.width, CAMERA.height)
    return cv2.warpAffine(ground, shift, size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def on_lens(image: Image, share: float) -> Image:
    """Drops and dirt that take `share` of the light."""
    rng = np.random.default_rng(7)
    dirt = np.zeros(image.shape[:2], np.float32)
    for _ in range(25):
        u, v, radius = rng.integers([0, 0, 6], [CAMERA.width, CAMERA.height, 20])
        cv2.circle(dirt, (int(u), int(v)), int(radius), 1.0, -1)
    dimmed = image * (1.0 - share * cv2.GaussianBlur(dirt, (0, 0), 3)[..., None])
    return dimmed.astype(np.uint8)


def in_cloud(image: Image, visible: float, rng: np.random.Generator) -> Image:
    hazy = 190 + (image - 128.0) * visible + rng.normal(0, 2, image.shape)
    return np.clip(hazy, 0, 255).astype(np.uint8)


def pattern_of_a_sensor(image: Image, light: float, rng: np.random.Generator) -> Image:
    """Pixels and columns of a dark image differ by a constant."""
    fixed = np.random.default_rng(9)
    offset = fixed.normal(0, 6, image.shape[:2]) + fixed.normal(0, 4, image.shape[1])
    dark = darken(image, light, 16.0, rng) + offset[..., None]
    return np.clip(dark, 0, 255).astype(np.uint8)


def faulty(kind: str) -> Spoil:
    lens = VideoFaultInjector(5)
    lens.set(PictureFault(kind))  # type: ignore[arg-type]
    return lambda image, k, rng: lens.apply(image, k * STEP_NS)


ATTACKS: dict[str, Spoil] = {
    "darkens": lambda image, k, rng: darken(image, 1e-3 * 0.6**k, 16.0, rng),
    "noise": lambda image, k, rng: darken(image, 5e-5, 16.0, rng),
    "sensor": lambda image, k, rng: pattern_of_a_sensor(image, 5e-5, rng),
    "dirt, into cloud": lambda image, k, rng: on_lens(in_cloud(image, 0.4 - 0.05 * k, rng), 0.3),
    "dirt, in cloud": lambda image, k, rng: on_lens(in_cloud(image, 0.0, rng), 0.3),
    "lens cap": faulty("covered"),
    "cloud": faulty("blinded"),
    "black": lambda image, k, rng: np.zeros_like(image),
    "white": lambda image, k, rng: np.full_like(image, 255),
}
HARMLESS: dict[str, Spoil] = {
    "clear": lambda image, k, rng: image,
    "dusk": lambda image, k, rng: darken(image, 0.02, 16.0, rng),
    "haze": lambda image, k, rng: in_cloud(image, 0.3, rng),
    "dirt": lambda image, k, rng: on_lens(image, 0.6),
}


def flown(
    ground: Image, spoil: Spoil, seed: int, *, hovers: bool = False, tilt_sigma_deg: float = 0.0
) -> list[tuple[float, float]]:
    """Error, m, and its squared distance in the covariance, of each usable step; both horizontal.
    The prediction is the tracker's. tilt_sigma_deg: noise of the autopilot's tilt.
    """
    extractor = DetailExtractor(load_extractor(threads=1, size=(WORKING.width, WORKING.height)))
    vo = VisualOdometry(WORKING, JNGO(threads=1), ground=FlatGround(0.0))
    rng, config, velocity = np.random.default_rng(seed), motion.MotionConfig(), np.zeros(3)
    velocity[1] = 0.0 if hovers else SPEED_M_S
    state = motion.start(PosePrior(pose(0), BEGUN, 0, velocity), config)
    previous, steps = None, []
    for k in range(FRAMES):
        true = pose(0 if hovers else k)
        image = spoil(view(ground, 0 if hovers else k), k, rng)
        fault = find_fault(image, previous)
        working = cv2.resize(image, (WORKING.width, WORKING.height), interpolation=cv2.INTER_AREA)
        frame = OdometryFrame(extractor.extract(working), k * STEP_NS, fault)
        tilt = so3_exp(np.radians([*rng.normal(0.0, tilt_sigma_deg, 2), 0.0]))
        attitude = attitude_constraint(tilt @ true.rotation, np.radians(0.4), np.radians(3.0))
        sensed = combine(attitude, height_constraint(HEIGHT_M, 0.5))
        previous = image
        if k == 0:
            vo.begin(frame, pose(0), BEGUN, velocity=velocity, constraint=sensed)
            continue
        state = motion.predict(state, k * STEP_NS, config, np.eye(3))
        estimate = vo.step(frame, state.prior, constraint=sensed)
        if estimate.usable:
            state = motion.update(state, estimate.world_from_camera, estimate.covariance)
            error = (estimate.world_from_camera.translation - true.translation)[:2]
            squared = error @ np.linalg.solve(estimate.covariance[:2, :2], error)
            steps.append((float(np.hypot(*error)), float(squared)))
    return steps


@pytest.mark.parametrize("attack", ATTACKS)
def test_what_does_not_show_the_ground_gives_no_wrong_step(ground, attack):
    """Steps were up to a flown way wrong: dirt and noise stay where they are in the image."""
    for seed in range(2):
        assert [s for s in flown(ground, ATTACKS[attack], seed) if s[1] > 13.8] == []  # 99.9 %


@pytest.mark.parametrize("harmless", HARMLESS)
def test_what_shows_the_ground_is_used(ground, harmless):
    steps = flown(ground, HARMLESS[harmless], 0)
    assert len(steps) == FRAMES - 1
    assert max(error for error, _ in steps) < 0.5


def test_a_hover_is_no_picture_that_stands_still(ground):
    """By 0.1 degrees of noise in the autopilot's tilt, half of a hover's steps were refused."""
    steps = flown(ground, HARMLESS["dusk"], 0, hovers=True, tilt_sigma_deg=0.2)
    assert len(steps) == FRAMES - 1
    assert max(error for error, _ in steps) < 0.5
