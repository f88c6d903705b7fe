"""Visual odometry: carries the pose on where the map does not match (docs/odometry.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localizer.errors import OdometryError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_log
from localizer.odometry.config import GrowthModel, OdometryConfig
from localizer.odometry.estimate import OdometryEstimate, OdometryFrame, OdometryStatus
from localizer.odometry.ground import FlatGround, Ground
from localizer.odometry.growth import (
    carried,
    distance_squared,
    fused,
    scaled,
    since,
    walked,
    weighed,
    without_constant_error,
)
from localizer.odometry.keyframe import DepthSource, Keyframe, keyframe_anchors
from localizer.registration.jngo import JNGO
from localizer.registration.priors import PoseConstraint
from localizer.registration.result import Registration
from localizer.types import PosePrior, RegistrationStatus

_CHI2_95 = 5.991  # two degrees of freedom
_SEARCH_M, _SEARCH_RAD = 1.0, float(np.radians(2.0))  # sigmas of a search without a prediction


@dataclass(frozen=True)
class _Beginning:
    """Where and when the pose was last known otherwise, and what a first keyframe is made of."""

    frame: OdometryFrame
    pose: Pose
    covariance: Array
    surface: Array | None
    constraint: PoseConstraint | None


@dataclass(frozen=True)
class _Track:
    """The last usable estimate. covariance: without the error of scale. constraint: what other
    sensors said, less their constant error. best: quality of the keyframe's first registration.
    """

    pose: Pose
    covariance: Array
    velocity: Array
    time_ns: int
    way_m: float
    aided_rotation: Array | None
    constraint: PoseConstraint | None
    best: float = 0.0


class VisualOdometry:
    """Registers each frame against a keyframe, by the map registration's features and optimizer.

    While the map matches, call `begin` with every accepted frame: it only keeps what it is given.
    When the map does not match, call `step` with every frame; it takes one registration, and a few
    milliseconds more where a new keyframe begins. Both belong to one thread (the localization
    thread); nothing is rendered here, and no thread is started.

    camera: the working pinhole of the features. optimizer: see `odometry_optimizer`. ground: a
    terrain model for where the map has no geometry; None: a plane at the height of the ground where
    the map was last seen.
    """

    def __init__(
        self,
        camera: Camera,
        optimizer: JNGO,
        config: OdometryConfig | None = None,
        ground: Ground | None = None,
        seed: int = 0,
    ) -> None:
        self._camera = camera
        self._optimizer = optimizer
        self.config = config or OdometryConfig()
        self._ground = ground
        self._plane: Ground | None = None
        self._seed = seed
        self._beginning: _Beginning | None = None
        self._keyframe: Keyframe | None = None
        self._track: _Track | None = None

    @property
    def ready(self) -> bool:
        """Whether there is a beginning to step from."""
        return self._beginning is not None

    def begin(
        self,
        frame: OdometryFrame,
        pose: Pose,
        covariance: Array,
        *,
        velocity: Array | None = None,
        surface: Array | None = None,
        constraint: PoseConstraint | None = None,
    ) -> None:
        """A frame whose pose is known by other means: the map, or the last fix before the loss.

        pose: world_from_camera, with its covariance (6, 6) as `PosePrior`'s. velocity: (3,) m/s,
        world axes. surface: (N, 3) world points of the map's surfaces there, the anchors of the
        reference that it was registered against. constraint: as for `step`, at this frame's time;
        what it contradicts the pose by is taken for the sensors' constant error, and made up for
        in every step. Costs nothing; the first `step` makes a keyframe of it. Whatever was bridged
        before is forgotten.
        """
        self._beginning = _Beginning(frame, pose, covariance, surface, constraint)
        self._keyframe = None
        speed = np.zeros(3) if velocity is None else np.asarray(velocity, dtype=np.float64)
        aided, corrected = _aided(constraint), self._corrected(constraint)
        self._track = _Track(pose, covariance, speed, frame.time_ns, 0.0, aided, corrected)
        if surface is not None and len(surface) > self._optimizer.config.min_anchors:
            self._plane = FlatGround.under(surface)

    def forget(self) -> None:
        """Nothing is known any more: `step` needs a new beginning."""
        self._beginning = self._keyframe = self._track = None

    def step(
        self,
        frame: OdometryFrame,
        prediction: PosePrior | None = None,
        *,
        surface: Array | None = None,
        constraint: PoseConstraint | None = None,
    ) -> OdometryEstimate:
        """The pose of the next frame.

        prediction: of the motion model, at the frame's time, that was fed with the last estimates
        of this odometry; None: constant velocity, turned by the constraint's turn. surface: (N, 3)
        world points of the map's surfaces as seen from about here: the anchors of the reference
        that was rendered for this frame, or None where the map has no geometry. constraint: what
        the autopilot knows at the frame's time (`registration.priors`): height by the barometer,
        roll and pitch, heading with the compass's real error; `combine` them.

        A status that is not OK means: do not use the pose; once it is LOST, only `begin` helps.
        """
        beginning, track = self._beginning, self._track
        if beginning is None or track is None:
            raise OdometryError("nothing to carry on from: call begin with a known pose first")
        keyframe = self._keyframe or self._first_keyframe(beginning)
        model = self._growth(keyframe)
        prior = prediction or self._ahead(track, frame.time_ns, constraint)
        if (gap := _seconds(track.time_ns, frame.time_ns)) > self.config.longest_gap_s:
            return self._failed(
                OdometryStatus.LOST, f"nothing usable for {gap:.1f} s", frame, prior, keyframe
            )
        if frame.usability is not None and frame.usability.fault is not None:
            return self._failed(
                OdometryStatus.UNUSABLE_IMAGE, frame.usability.fault.value, frame, prior, keyframe
            )
        result = self._optimizer.register(
            frame.features,
            self._camera,
            keyframe.anchors,
            prior,
            motion=prior,
            seed=self._seed + frame.time_ns % 1_000_003,
        )
        if reason := self._fault(result, prior):
            return self._failed(OdometryStatus.NOT_REGISTERED, reason, frame, prior, keyframe)
        after = self._followed(track, keyframe, model, result, frame.time_ns, constraint)
        self._track = after
        estimate = self._estimate(
            OdometryStatus.OK, "", frame.time_ns, after, keyframe, after.pose, result.quality
        )
        if self._is_spent(keyframe, result, after):
            self._hand_over(frame, after, surface)
        return estimate

    def _growth(self, keyframe: Keyframe) -> GrowthModel:
        by_map = keyframe.source is DepthSource.MAP
        return self.config.with_map if by_map else self.config.with_ground

    def _first_keyframe(self, beginning: _Beginning) -> Keyframe:
        constraint = self._corrected(beginning.constraint)
        made = self._make_keyframe(
            beginning.frame, beginning.pose, beginning.covariance, 0.0, beginning.surface,
            constraint,
        )  # fmt: skip
        if made is None:
            raise OdometryError(
                "neither the map nor a ground gives the first keyframe a depth: call begin with "
                "the surface of the reference, or give the odometry a ground"
            )
        self._keyframe = made
        return made

    def _make_keyframe(
        self, frame: OdometryFrame, pose: Pose, covariance: Array, way_m: float,
        surface: Array | None, constraint: PoseConstraint | None,
    ) -> Keyframe | None:  # fmt: skip
        anchors, source = keyframe_anchors(
            frame.features, self._camera, pose, surface, self._ground or self._plane,
            self.config.anchors, self._seed,
        )  # fmt: skip
        if len(anchors.points_world) < 2 * self._optimizer.config.min_anchors:
            return None
        return Keyframe(anchors, pose, covariance, frame.time_ns, source, way_m, constraint)

    def _hand_over(self, frame: OdometryFrame, track: _Track, surface: Array | None) -> None:
        """The frame becomes the keyframe, unless it has too little depth for one."""
        made = self._make_keyframe(
            frame, track.pose, track.covariance, track.way_m, surface, track.constraint
        )
        if made is not None:
            self._keyframe, self._track = made, replace(track, best=0.0)

    def _ahead(self, track: _Track, time_ns: int, constraint: PoseConstraint | None) -> PosePrior:
        dt = _seconds(track.time_ns, time_ns)
        rotation, aided = track.pose.rotation, _aided(constraint)
        if aided is not None and track.aided_rotation is not None:
            rotation = aided @ track.aided_rotation.T @ rotation
        pose = Pose(rotation, track.pose.translation + track.velocity * dt)
        reach = _SEARCH_M + 0.5 * self.config.acceleration_sigma * dt**2
        sigma = np.repeat([reach, _SEARCH_RAD * (1.0 + dt)], 3)
        return PosePrior(pose, np.diag(sigma**2), time_ns, track.velocity)

    def _fault(self, result: Registration, prior: PosePrior) -> str:
        """Why a registration is not used; "" if it is."""
        c = self.config
        if result.status is not RegistrationStatus.OK:
            return str(result.status.value)
        if result.quality < c.min_quality:
            return f"quality {result.quality:.2f} is below {c.min_quality:g}"
        if result.overlap < c.min_overlap:
            return f"overlap {result.overlap:.2f} is below {c.min_overlap:g}"
        sigma = float(np.sqrt(result.covariance.diagonal()[:3].max()))
        if sigma > c.max_sigma_m:
            return f"position sigma {sigma:.1f} m is beyond {c.max_sigma_m:g}"
        if distance_squared(prior, result.world_from_camera, result.covariance) > c.gate:
            return "the pose contradicts the prediction"
        return ""

    def _followed(
        self,
        track: _Track,
        keyframe: Keyframe,
        model: GrowthModel,
        result: Registration,
        time_ns: int,
        constraint: PoseConstraint | None,
    ) -> _Track:
        """The track after a registration against the keyframe."""
        begun = keyframe.world_from_camera
        hop = float(np.linalg.norm(result.world_from_camera.translation - begun.translation))
        relative = model.registration * result.covariance + walked(model, hop)
        pose, corrected = result.world_from_camera, self._corrected(constraint)
        if keyframe.constraint is not None and corrected is not None:
            c = self.config
            turn = np.radians([c.turn_sigma_deg, c.turn_sigma_deg, c.heading_turn_sigma_deg])
            if known := since(keyframe.constraint, corrected, begun, turn, c.rise_sigma_m):
                pose, relative = weighed(pose, relative, known)
        lever = pose.translation - begun.translation
        pose, covariance = fused(pose, carried(keyframe.covariance, lever) + relative, corrected)
        dt = _seconds(track.time_ns, time_ns)
        velocity = track.velocity
        if dt > 0:
            velocity = (pose.translation - track.pose.translation) / dt
        return _Track(
            pose, covariance, velocity, time_ns, keyframe.way_m + hop, _aided(constraint),
            corrected, track.best or result.quality,
        )  # fmt: skip

    def _corrected(self, constraint: PoseConstraint | None) -> PoseConstraint | None:
        """The constraint without the constant error that it had at the beginning."""
        assert self._beginning is not None
        then = self._beginning.constraint
        if constraint is None or then is None:
            return constraint
        return without_constant_error(constraint, then, self._beginning.pose)

    def _is_spent(self, keyframe: Keyframe, result: Registration, track: _Track) -> bool:
        c = self.config
        turn = so3_log(track.pose.rotation @ keyframe.world_from_camera.rotation.T)
        return (
            result.overlap < c.new_below_overlap
            or result.quality < c.new_below_quality * track.best
            or float(np.degrees(np.linalg.norm(turn))) > c.new_beyond_turn_deg
        )

    def _failed(
        self,
        status: OdometryStatus,
        reason: str,
        frame: OdometryFrame,
        prior: PosePrior,
        keyframe: Keyframe,
    ) -> OdometryEstimate:
        """The prediction, with what may have happened since the last usable frame."""
        assert self._track is not None
        dt = _seconds(self._track.time_ns, frame.time_ns)
        grown = self._track.covariance + prior.covariance
        grown[:3, :3] += np.eye(3) * (0.5 * self.config.acceleration_sigma * dt**2) ** 2
        blind = replace(self._track, covariance=grown)
        return self._estimate(
            status, reason, frame.time_ns, blind, keyframe, prior.world_from_camera, 0.0
        )

    def _estimate(
        self,
        status: OdometryStatus,
        reason: str,
        time_ns: int,
        track: _Track,
        keyframe: Keyframe,
        pose: Pose,
        quality: float,
    ) -> OdometryEstimate:
        assert self._beginning is not None
        begun = self._beginning
        way = pose.translation - begun.pose.translation
        covariance = track.covariance + scaled(self._growth(keyframe), way)
        known = carried(begun.covariance, way)
        added = np.linalg.eigvalsh((covariance - known)[:2, :2])[-1]
        return OdometryEstimate(
            pose, covariance, quality, status, reason, time_ns,
            bridged_s=_seconds(begun.frame.time_ns, time_ns),
            way_m=track.way_m,
            drift_m=float(np.sqrt(_CHI2_95 * max(added, 0.0))),
            keyframe_age_s=_seconds(keyframe.time_ns, time_ns),
            source=keyframe.source,
        )  # fmt: skip


def odometry_optimizer(optimizer: JNGO, threads: int = 2) -> JNGO:
    """The map registration's optimizer, set up for odometry; it shares the backend.

    Two pictures of one flight see the same things, so the map's own error is no part of the
    covariance.
    """
    config = optimizer.config.model_copy(update={"map_error_m2": 0.0})
    return JNGO(config, optimizer.backend, threads)


def _aided(constraint: PoseConstraint | None) -> Array | None:
    """The rotation that a constraint knows."""
    known = constraint is not None and bool(np.diag(constraint.information)[3:].all())
    return constraint.world_from_camera.rotation if known and constraint is not None else None


def _seconds(begin_ns: int, end_ns: int) -> float:
    return (end_ns - begin_ns) * 1e-9
