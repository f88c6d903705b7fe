"""Tests a position found by search with independent evidence.

A wrong position that looks right looks right again in the next frames of the same view, so repeated
acceptance proves little. Independent evidence is: continued matching while the vehicle moves on,
the autopilot's attitude by gravity and compass, and its inertial displacement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from localizer.geometry.pose import Array, Pose, so3_log
from localizer.integrity.acceptance import IntegrityConfig

# By another sensor's account: displacement (3,) in world axes (m) between two times (ns), and its
# sigma (m); None where it does not know.
DisplacementBetween = Callable[[int, int], "tuple[Array, float] | None"]

_SIGMAS = 3.0
_SLACK_M = 1.5  # of two displacements over seconds, beside what their sigmas say
_TURN_RAD = np.radians(15.0)  # a view that turned by this shows other ground


class Consistency(Enum):
    """Result of the evidence for a found position so far."""

    PENDING = "pending"
    CONFIRMED = "confirmed"
    CONTRADICTED = "contradicted"


@dataclass(frozen=True)
class TentativeTrack:
    """The first accepted pose after a search. covariance: (6, 6); time_ns: its exposure.

    independent_prior: whether the proposed position does not derive from our own fixes, for example
    that of an autopilot with healthy GNSS. Agreement with such a position confirms the track.
    """

    world_from_camera: Pose
    covariance: Array
    time_ns: int
    independent_prior: bool = False


@dataclass(frozen=True)
class IndependentEvidence:
    """Evidence of other sensors. rotation: (3, 3) world_from_camera at the newest acceptance, or
    None; displacement: (3,) metres since the track became tentative, with its sigma (m), or None.
    """

    rotation: Array | None = None
    displacement: tuple[Array, float] | None = None


def consistency_test(
    tentative_track: TentativeTrack,
    pose: Pose,
    covariance: Array,
    time_ns: int,
    evidence: IndependentEvidence,
    config: IntegrityConfig,
) -> Consistency:
    """Test a tentative track by another registered pose (covariance (6, 6), exposure time_ns) and
    by other sensors' evidence.
    """
    if evidence.rotation is not None and not _attitude_agrees(pose, evidence.rotation, config):
        return Consistency.CONTRADICTED
    moved = pose.translation - tentative_track.world_from_camera.translation
    if evidence.displacement is not None:
        seen, sigma_m = evidence.displacement
        own = np.sqrt((tentative_track.covariance + covariance).diagonal()[:3].max())
        limit = _SLACK_M + _SIGMAS * (sigma_m + own)
        if np.linalg.norm(moved - seen) > limit:
            return Consistency.CONTRADICTED
    if tentative_track.independent_prior:
        return Consistency.CONFIRMED
    turned = so3_log(pose.rotation @ tentative_track.world_from_camera.rotation.T)
    noise_m = _noise_m(moved, tentative_track.covariance + covariance)
    has_moved = np.linalg.norm(moved) >= max(config.confirm_distance_m, noise_m)
    has_moved = has_moved or np.linalg.norm(turned) >= _TURN_RAD
    has_stayed = (time_ns - tentative_track.time_ns) * 1e-9 >= config.confirm_still_s
    # A hovering camera sees the same ground again: without the autopilot's attitude beside it,
    # that the map goes on matching says nothing new.
    has_stayed = has_stayed and evidence.rotation is not None
    return Consistency.CONFIRMED if has_moved or has_stayed else Consistency.PENDING


def _noise_m(moved: Array, covariance: Array) -> float:
    """Limit (m) of the apparent displacement (3,) that noise causes: estimates slide along similar
    structures, and the same view is seen again. covariance: (6, 6), of the displacement.
    """
    along = moved / max(float(np.linalg.norm(moved)), 1e-9)
    return _SIGMAS * float(np.sqrt(along @ covariance[:3, :3] @ along))


def _attitude_agrees(pose: Pose, rotation: Array, config: IntegrityConfig) -> bool:
    """Whether the pose's tilt and heading agree with another sensor's rotation (3, 3)."""
    turn = so3_log(pose.rotation @ rotation.T)
    tilt, heading = np.hypot(turn[0], turn[1]), abs(turn[2])
    return bool(
        tilt <= np.radians(config.confirm_tilt_deg)
        and heading <= np.radians(config.confirm_heading_deg)
    )
