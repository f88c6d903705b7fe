"""A reference view serves as long as the camera sees nearly what it shows, and no longer."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.registration.agreement import PatchAgreement
from localizer.registration.result import Registration
from localizer.tracking.pipeline import Localizer
from localizer.tracking.reference import is_still_valid, lead_share
from localizer.types import (
    Anchors,
    FeatureLevel,
    FeaturePyramid,
    Frame,
    PosePrior,
    ReferenceBundle,
    RegistrationStatus,
    RenderedView,
    TrackingState,
)

CAMERA = Camera.from_fov(320, 240, 60.0)
NADIR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 100.0]))
METRES_PER_PX = 100.0 / CAMERA.fx
SECOND_NS = 10**9


def _reference() -> ReferenceBundle:
    """Of flat ground 100 m below."""
    shape = (CAMERA.height, CAMERA.width)
    view = RenderedView(np.zeros((*shape, 3), np.uint8), np.full(shape, 100.0, np.float32),
                        NADIR, CAMERA)  # fmt: skip
    v, u = np.mgrid[20:220:8, 20:300:8]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5
    points = NADIR.apply(100.0 * CAMERA.rays(pixels))
    return ReferenceBundle(view, Anchors(points, pixels.astype(np.float32), (), ()), SECOND_NS)


def _moved(east_px: float = 0.0, up_m: float = 0.0, yaw_deg: float = 0.0) -> Pose:
    shift = np.array([east_px * METRES_PER_PX, 0.0, up_m])
    turn = so3_exp(np.radians([0.0, 0.0, yaw_deg]))
    return Pose(turn @ NADIR.rotation, NADIR.translation + shift)


@pytest.mark.parametrize(
    ("pose", "serves"),
    [
        (_moved(), True),
        (_moved(east_px=7.0), True),
        (_moved(east_px=9.0), False),
        (_moved(up_m=3.0), True),
        (_moved(up_m=10.0), False),  # the middle stays, the border moves
        (_moved(yaw_deg=2.0), True),
        (_moved(yaw_deg=6.0), False),
        (Pose(np.diag([1.0, 1.0, 1.0]), NADIR.translation), False),  # looks up
    ],
)
def test_it_serves_while_its_picture_moves_by_less_than_said(pose, serves):
    assert is_still_valid(_reference(), pose, CAMERA, SECOND_NS + 1, 8.0) is serves


def test_it_does_not_serve_for_longer_than_a_second_nor_backwards_nor_where_it_is_switched_off():
    reference = _reference()
    assert not is_still_valid(reference, NADIR, CAMERA, 2 * SECOND_NS + 1, 8.0)
    assert not is_still_valid(reference, NADIR, CAMERA, SECOND_NS - 1, 8.0)
    assert not is_still_valid(reference, NADIR, CAMERA, SECOND_NS + 1, 0.0)


def test_it_does_not_serve_a_lens_that_has_zoomed_since():
    slightly, far = (replace(CAMERA, fx=CAMERA.fx * f, fy=CAMERA.fy * f) for f in (1.01, 1.2))
    assert is_still_valid(_reference(), NADIR, slightly, SECOND_NS + 1, 8.0)
    assert not is_still_valid(_reference(), NADIR, far, SECOND_NS + 1, 8.0)


def test_a_reference_without_anchors_does_not_serve():
    few = Anchors(np.zeros((3, 3)), np.zeros((3, 2), np.float32), (), ())
    assert not is_still_valid(replace(_reference(), anchors=few), NADIR, CAMERA, SECOND_NS + 1, 8.0)


class _Renderer:
    name = "fake"

    def __init__(self) -> None:
        self.count, self.frame = 0, 0
        self.rendered: list[tuple[int, Pose]] = []

    def render(self, world_from_camera, camera, extra=(), *, wait=False):
        self.count += 1
        self.rendered.append((self.frame, world_from_camera))
        shape = (camera.height, camera.width)
        depth = np.full(shape, world_from_camera.translation[2], np.float32)
        return RenderedView(np.zeros((*shape, 3), np.uint8), depth, world_from_camera, camera)


class _Extractor:
    name = "fake"

    def extract(self, rgb):
        h, w = rgb.shape[:2]
        shape = (h // 8, w // 8)
        level = FeatureLevel(np.ones((*shape, 4), np.float32), np.ones(shape, np.float32), 8)
        return FeaturePyramid((level,), w, h)


class _Optimizer:
    """Finds the camera where it is: `east_m`; status: what it says of it."""

    on_gpu = False
    backend = SimpleNamespace(name="fake")

    def __init__(self) -> None:
        self.east_m, self.status = 0.0, RegistrationStatus.OK

    def register(self, query, camera, anchors, prior, *, motion=None, constraint=None, seed=0):
        pose = Pose(NADIR.rotation, NADIR.translation + np.array([self.east_m, 0.0, 0.0]))
        seen = PatchAgreement(patches=60, votes=58, peak=6.0, patch_peak=3.5)
        return Registration(pose, np.eye(6) * 1e-4, 0.1, 0.9, 0.8, self.status, 1, seen)


class _Flight:
    """Frames 0.1 s apart, `step_m` to the east each."""

    def __init__(self, step_m: float, shift_px: float = 8.0, width: int = 320) -> None:
        self.renderer, self.optimizer, self.step_m = _Renderer(), _Optimizer(), step_m
        self.loading = False
        config = LocalizerConfig(width=width, odometry=None, reference_shift_px=shift_px)
        self.localizer = Localizer(
            self.renderer, _Extractor(), self.optimizer,  # type: ignore[arg-type]
            CAMERA, config, is_loading=lambda: self.loading,
        )  # fmt: skip
        velocity = np.array([10 * step_m, 0.0, 0.0])
        self.localizer.set_prior(PosePrior(NADIR, np.eye(6) * 0.01, SECOND_NS, velocity))

    def fly(self, frames: range) -> int:
        """How many references the frames took."""
        before = self.renderer.count
        for k in frames:
            self.optimizer.east_m, self.renderer.frame = self.step_m * k, k
            image = np.zeros((240, 320, 3), np.uint8)
            self.localizer.track(Frame(image, SECOND_NS + k * SECOND_NS // 10, CAMERA, k))
        return self.renderer.count - before


@pytest.mark.parametrize("width", [320, 640])
def test_a_slow_flight_takes_fewer_references_than_frames_and_a_fast_one_as_many(width):
    slow = _Flight(step_m=2.0 * METRES_PER_PX, width=width)
    slow.fly(range(5))
    assert slow.localizer.tracker.track_status.state is TrackingState.TRACKING
    # 2 px of 320 a frame; a reference serves from 6 px before its place to 8 px behind it
    assert slow.fly(range(5, 25)) in (2, 3)
    fast = _Flight(step_m=10.0 * METRES_PER_PX, width=width)
    fast.fly(range(5))
    assert fast.fly(range(5, 15)) == 10


def test_it_is_rendered_ahead_and_serves_at_once():
    flight = _Flight(step_m=4.0 * METRES_PER_PX)
    flight.fly(range(20))
    ahead_px = [
        (pose.translation[0] - flight.step_m * k) / METRES_PER_PX
        for k, pose in flight.renderer.rendered
        if k >= 10
    ]
    assert ahead_px
    assert min(ahead_px) > 5.0
    assert max(ahead_px) < 7.0  # with more than 8 it would not serve the frame it is made for


def test_how_far_ahead_it_is_rendered():
    reference, here = _reference(), _moved()
    assert lead_share(reference, here, _moved(east_px=12.0), 8.0, 0.5) == pytest.approx(0.5)
    assert lead_share(reference, here, _moved(east_px=0.01), 8.0, 0.5) == 1.0
    assert lead_share(reference, here, here, 8.0, 0.5) == 1.0
    # one frame moves by more than the limit: the reference is that frame's alone
    assert lead_share(reference, here, _moved(east_px=18.0), 8.0, 0.5) == 0.0
    few = Anchors(np.zeros((3, 3)), np.zeros((3, 2), np.float32), (), ())
    assert lead_share(replace(reference, anchors=few), here, here, 8.0, 0.5) == 0.0


def test_a_flight_that_needs_one_for_every_frame_has_it_where_the_frame_is():
    fast = _Flight(step_m=10.0 * METRES_PER_PX)
    fast.fly(range(15))
    later = [(k, pose) for k, pose in fast.renderer.rendered if k >= 5]
    assert len(later) >= 9
    for k, pose in later:
        assert pose.translation[0] == pytest.approx(fast.step_m * k, abs=METRES_PER_PX)


def test_every_frame_has_its_own_where_that_is_wanted():
    flight = _Flight(step_m=0.0, shift_px=0.0)
    assert flight.fly(range(10)) == 10


def test_it_is_made_anew_while_tiles_are_on_their_way():
    flight = _Flight(step_m=0.0)
    flight.fly(range(5))
    assert flight.fly(range(5, 9)) == 0
    flight.loading = True
    assert flight.fly(range(9, 12)) == 3


def test_it_is_made_anew_where_the_map_does_not_answer():
    flight = _Flight(step_m=0.0)
    flight.fly(range(5))
    flight.optimizer.status = RegistrationStatus.NO_OVERLAP
    assert flight.fly(range(5, 9)) >= 3  # all but the first, which did not know yet
