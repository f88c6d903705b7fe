"""Registrations one after another: which of them the track believes."""

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.registration.result import Registration
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.sensor_fusion import FusedRegistration
from localizer.tracking.tracker import Tracker
from localizer.types import FeaturePyramid, Frame, PosePrior, RegistrationStatus, TrackingState

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
STEP_NS = 125_000_000
SPEED = np.array([6.0, 0.0, 0.0])
# Of a flight over a town (`gnss-returns-right`, seed 5): a wrong optimum 3 m aside, for a second.
ASIDE, TURN = np.array([-2.4, 1.0, 2.0]), np.radians([0.1, -0.2, -1.9])
WRONG = np.diag([1.0, 1.0, 0.77, 0.011, 0.011, 0.011]) ** 2
RIGHT = np.diag([0.73, 0.73, 0.29, 0.0085, 0.0085, 0.0085]) ** 2
NOISE = np.diag([0.1, 0.1, 0.1, 0.001, 0.001, 0.001]) ** 2


class Flight:
    """A tracker that is given registrations of a straight flight."""

    def __init__(self) -> None:
        self.tracker = Tracker(LocalizerConfig(), AuxiliarySensors(), None)
        self.count = 0
        start = Pose(np.eye(3), np.array([0.0, 0.0, 100.0]))
        self.tracker.set_prior(PosePrior(start, RIGHT, 0, SPEED))

    def see(self, aside: np.ndarray, turn: np.ndarray, covariance: np.ndarray):
        self.count += 1
        time_ns = self.count * STEP_NS
        true = np.array([0.0, 0.0, 100.0]) + SPEED * time_ns * 1e-9
        result = Registration(
            Pose(so3_exp(turn), true + aside), covariance, 0.1, 0.9, 0.5, RegistrationStatus.OK, 1,
            noise=NOISE,
        )  # fmt: skip
        image = np.zeros((48, 64, 3), np.uint8)
        frame = Frame(image, time_ns, self.count, CAMERA)
        seen = self.tracker.state
        ahead = self.tracker.at_frame(seen, time_ns)
        assert ahead is not None
        fused = FusedRegistration(result)
        given = self.tracker.update(seen, ahead, frame, FeaturePyramid((), 64, 48), None, fused)
        return given, float(np.linalg.norm(given.world_from_camera.translation - true))


@pytest.fixture
def flight(monkeypatch) -> Flight:
    monkeypatch.setattr("localizer.integrity.acceptance.log_odds", lambda _: 9.0)
    return Flight()


def test_a_right_registration_ends_a_track_that_is_as_wrong_as_it_says(flight):
    for _ in range(8):
        flight.see(np.zeros(3), np.zeros(3), RIGHT)
    for share in (0.3, 0.6, 0.9, 1.0, 1.0, 1.0, 1.0, 1.0):
        given, off_m = flight.see(share * ASIDE, share * TURN, WRONG)
    assert given.accepted
    assert off_m > 2.0
    given, off_m = flight.see(np.zeros(3), np.zeros(3), RIGHT)
    assert given.accepted
    assert given.state is TrackingState.TRACKING
    assert off_m < 0.5  # not half way: the motion is begun again there


def test_a_registration_beyond_all_sigmas_is_refused(flight):
    for _ in range(16):
        flight.see(np.zeros(3), np.zeros(3), RIGHT)
    given, _ = flight.see(4.0 * ASIDE, TURN, RIGHT)
    assert not given.accepted
