"""Steps between overlapping photos of a real flight, over its surface model."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from localizer.odometry.estimate import OdometryEstimate, OdometryFrame
from localizer.odometry.odometry import VisualOdometry
from localizer.pictures import read_rgb
from localizer.registration.jngo import JNGO
from localizer.tracking.pipeline import Undistorter, working_camera
from localizer.types import Frame, PosePrior

pytestmark = pytest.mark.real

BEGUN = np.diag([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3]) ** 2
PREDICTED = np.diag([1.5, 1.5, 1.5, 0.05, 0.05, 0.05]) ** 2
TURN_RAD = np.radians(1.0)  # sigma of a prediction's attitude
BEGIN_NS, STEP_NS = 1_000_000_000, 1_000_000_000
LEAST_OVERLAP, MOST_TURN = 0.4, np.radians(25.0)  # of a video's frames: without a strip flown back


class PhotoFlight:
    """Photos with their poses and the surface below."""

    def __init__(self, folder: Path) -> None:
        self._photos = folder / "queries"
        told = json.loads((self._photos / "poses.json").read_text(encoding="utf-8"))
        self.poses = {name: Pose.from_matrix(t["T_enu_from_cam"]) for name, t in told.items()}
        source = Camera.from_json(self._photos / "camera.json")
        self.camera = working_camera(source, 320)
        self._undistort = Undistorter(source, self.camera)
        size = (self.camera.width, self.camera.height)
        self._extractor = DetailExtractor(load_extractor(threads=1, size=size))
        self._ground = np.asarray(trimesh.load(folder / "mesh.glb", force="mesh").vertices)
        self._source = source

    def frame(self, name: str, time_ns: int) -> OdometryFrame:
        image = read_rgb(self._photos / "images" / name)
        pixels = self._undistort(Frame(image, time_ns, self._source, 0))
        return OdometryFrame(self._extractor.extract(pixels), time_ns)

    def surface(self, name: str) -> Array:
        """Ground points (N, 3) in a photo."""
        return self._ground[self._sees(name, self._ground)]

    def follows(self, one: str, other: str) -> bool:
        """Whether two photos could be frames of one video."""
        turn = self.poses[one].rotation.T @ self.poses[other].rotation
        is_alike = float(np.linalg.norm(so3_log(turn))) < MOST_TURN
        return is_alike and self._sees(other, self.surface(one)).mean() > LEAST_OVERLAP

    def step(self, begun: str, seen: str, prediction: Pose) -> OdometryEstimate:
        """From a photo with a known pose to what is seen, a second later."""
        odometry = VisualOdometry(self.camera, JNGO(threads=1))
        surface = self.surface(begun)
        odometry.begin(self.frame(begun, BEGIN_NS), self.poses[begun], BEGUN, surface=surface)
        prior = PosePrior(prediction, PREDICTED, BEGIN_NS + STEP_NS)
        return odometry.step(self.frame(seen, BEGIN_NS + STEP_NS), prior, surface=surface)

    def _sees(self, name: str, points: Array) -> NDArray[np.bool_]:
        return self.camera.project(self.poses[name].inverse.apply(points))[1]


@pytest.fixture(scope="module")
def flight(real_data: Callable[[str], Path]) -> PhotoFlight:
    return PhotoFlight(real_data("caliterra"))


@pytest.fixture(scope="module")
def pairs(flight: PhotoFlight) -> list[tuple[str, str]]:
    return [pair for pair in permutations(flight.poses, 2) if flight.follows(*pair)]


def predicted(pose: Pose, rng: np.random.Generator, off_m: float = 0.0) -> Pose:
    """With errors of 1 m and 1 degree, or off_m to a side."""
    aside = rng.uniform(0.0, 2.0 * np.pi)
    shift = rng.normal(0.0, 1.0, 3)
    if off_m:
        shift[:2] = off_m * np.cos(aside), off_m * np.sin(aside)
    return Pose(so3_exp(rng.normal(0.0, TURN_RAD, 3)) @ pose.rotation, pose.translation + shift)


def test_each_step_of_a_real_flight_is_accepted(flight, pairs):
    rng = np.random.default_rng(3)
    assert len(pairs) >= 10
    for one, other in pairs:
        step = flight.step(one, other, predicted(flight.poses[other], rng))
        metres, degrees = step.world_from_camera.distance_to(flight.poses[other])
        assert step.usable, (one, other, step.reason)
        assert metres < 0.4, (one, other)
        assert degrees < 0.4, (one, other)


def test_none_is_accepted_that_contradicts_its_prediction(flight, pairs):
    rng = np.random.default_rng(4)
    for one, other in pairs:
        assert not flight.step(one, other, predicted(flight.poses[other], rng, off_m=8.0)).usable
        # The aircraft moved, its picture did not.
        assert not flight.step(one, one, predicted(flight.poses[other], rng)).usable
