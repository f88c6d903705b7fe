"""Localizes each frame independently: from its prior, or by a search."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from companion.errors import StreamDecodeError, StreamSizeError
from companion.recorded.flight import RecordedFrame
from companion.trial.priors import FramePrior
from localizer.errors import OutsideMapError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.relocalization.relocalizer import Relocalizer
from localizer.relocalization.types import PlaceQuery, SearchRegion
from localizer.tracking.pipeline import Localizer
from localizer.types import Frame, PosePrior, RegistrationStatus

_PASSES = 3  # the view from a prior that is metres off shows another place
_STEP_NS = 10_000_000_000  # between frames: no motion model carries from one photo to the next
_REGION_SIGMAS, _LEAST_REGION_M = 3.0, 30.0
_LEAST_SHARE = 0.15  # of a height above ground, from which an uncertain one is searched
_HEIGHT_BANDS = 4  # of an unknown height, 15 to 150 m: a middle errs by 1.4 times at most
_FOUND_HEIGHT_SHARE = 0.15  # heights of one flight differ by less, as a rule


@dataclass(frozen=True)
class Localized:
    """One frame's result. pose: of the registration, even if not accepted; None: `problem` says
    why. covariance: (6, 6) as `PosePrior`'s; quality: 0 to 1; searched: found by the relocalizer,
    not from a prior; beside_map: the view does not meet the map.
    """

    name: str
    pose: Pose | None
    covariance: Array | None = None
    quality: float = 0.0
    accepted: bool = False
    searched: bool = False
    problem: str = ""
    beside_map: bool = False


class FrameLocalizer:
    """Localizes recorded frames independently. relocalizer: opens it at the first search. camera:
    of the footage. recorded_poses: receives each complete prior by its time (ns), from which
    `sensors_of` gives the localizer attitude and height.
    """

    def __init__(
        self, localizer: Localizer, relocalizer: Callable[[], Relocalizer], camera: Camera,
        recorded_poses: dict[int, Pose] | None = None,
    ) -> None:  # fmt: skip
        self._localizer, self._relocalizer, self._camera = localizer, relocalizer, camera
        self._recorded_poses = {} if recorded_poses is None else recorded_poses
        self._loaded = 0
        self._found_heights_m: list[float] = []  # of frames whose height was not known

    def load(self, recorded: RecordedFrame) -> Frame:
        """Load the image with its camera model, zoom included. Raises stream errors."""
        self._loaded += 1
        # One sequence number, which seeds the hypotheses: the order of photos changes nothing.
        return recorded.load(self._camera, self._loaded * _STEP_NS)

    def from_prior(self, recorded: RecordedFrame, prior: FramePrior) -> Localized:
        """Localize from telemetry; an unknown heading or height is searched near the position,
        which takes 10 to 40 s. Raises nothing for an image that cannot be used.
        """
        if prior.pose is None:
            return Localized(recorded.name, None, problem="has no position")
        try:
            frame = self.load(recorded)
        except (StreamDecodeError, StreamSizeError, OSError) as error:
            return Localized(recorded.name, None, problem=str(error))
        if prior.is_complete:
            if prior.pose is not None and not prior.was_searched:
                self._recorded_poses[frame.exposure_time_ns] = prior.pose
            return self._tracked(recorded.name, frame, prior.pose_prior(frame.exposure_time_ns))
        radius = max(_REGION_SIGMAS * prior.sigma_m, _LEAST_REGION_M)
        region = SearchRegion.circle(prior.pose.translation[:2], radius)
        return self._search(recorded.name, frame, prior, region)

    def search_map(self, recorded: RecordedFrame, prior: FramePrior) -> Localized:
        """Localize by a search of the whole map, without the frame's position but with its angles
        and height (`prior`). For an image that cannot be read the result holds the reason; nothing
        is raised.
        """
        try:
            frame = self.load(recorded)
        except (StreamDecodeError, StreamSizeError, OSError) as error:
            return Localized(recorded.name, None, problem=str(error))
        return self._search(recorded.name, frame, prior, None)

    def _tracked(self, name: str, frame: Frame, prior: PosePrior) -> Localized:
        self._localizer.set_prior(prior)
        try:
            estimate = self._localizer.track(frame, passes=_PASSES)
        except OutsideMapError as error:
            return Localized(name, None, problem=str(error), beside_map=True)
        if estimate.status is not RegistrationStatus.OK:
            return Localized(name, None, problem=estimate.status.value)
        return Localized(
            name, estimate.world_from_camera, estimate.covariance, estimate.quality,
            estimate.accepted,
        )  # fmt: skip

    def _search(
        self, name: str, frame: Frame, prior: FramePrior, region: SearchRegion | None
    ) -> Localized:
        heading = prior.heading_sigma_deg
        query = PlaceQuery(
            frame, prior.rotation, math.radians(prior.tilt_sigma_deg),
            None if heading is None else math.radians(heading), prior.height_m,
            prior.height_sigma_m, region,
        )  # fmt: skip
        bands = [(prior.height_m, prior.height_sigma_m)]
        if not prior.height_known:
            bands = likely_height(prior, self._found_heights_m) or height_bands(prior)
        tried = (
            self._relocalizer().find(replace(query, height_m=height_m, height_sigma_m=sigma_m))
            for height_m, sigma_m in bands
        )
        found = max((one for one in tried if one), key=lambda one: one.quality, default=None)
        if found is None:
            return Localized(name, None, searched=True, problem="no position was confirmed")
        if not prior.height_known:
            self._found_heights_m.append(float(found.world_from_camera.translation[2]))
        return Localized(name, found.world_from_camera, found.covariance, found.quality, True, True)


def likely_height(prior: FramePrior, found_m: Sequence[float]) -> list[tuple[float, float]]:
    """World z and its sigma (m) for a search, from the heights (m) of frames found so far: the
    latest on which two agree, as one photo may be of the climb. Empty if no two agree.
    """
    ground = prior.height_m - prior.clearance_m
    for one, other in combinations(reversed(found_m), 2):
        sigma = max(_FOUND_HEIGHT_SHARE * abs(one - ground), 5.0)
        if abs(one - other) < sigma:
            return [(one, sigma)]
    return []


def height_bands(prior: FramePrior) -> list[tuple[float, float]]:
    """Split the range of an unknown height into four: (middle, half range), world z, m. A search
    registers its candidates from the middle; from twice or half the true height that fails. The
    range begins above the ground, also if the sigma is larger than the height above it.
    """
    clearance, half = prior.clearance_m, prior.height_sigma_m
    ground, low = prior.height_m - clearance, max(clearance - half, _LEAST_SHARE * clearance)
    edges = np.geomspace(low, clearance + half, _HEIGHT_BANDS + 1)
    return [(ground + (a + b) / 2, (b - a) / 2) for a, b in pairwise(map(float, edges))]


def horizontal_m(a: Pose, b: Pose) -> float:
    """Horizontal distance between two cameras, m."""
    return float(np.hypot(*(a.translation - b.translation)[:2]))
