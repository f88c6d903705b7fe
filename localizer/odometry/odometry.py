"""Visual odometry: propagates the pose where the map does not match (odometry.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from localizer.errors import OdometryError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_log
from localizer.odometry.config import OdometryConfig
from localizer.odometry.estimate import OdometryEstimate, OdometryFrame, OdometryStatus
from localizer.odometry.ground import (
    FlatGround,
    RaisedGround,
    RangefinderGround,
    TerrainModel,
    height_above_ground,
)
from localizer.odometry.growth import transferred
from localizer.odometry.keyframe import DepthSource, Keyframe, keyframe_anchors
from localizer.odometry.parallax import ParallaxView, align
from localizer.odometry.track import (
    OdometryStart,
    OdometryTrack,
    aided_rotation,
    growth_of,
    rejection,
    seconds,
    track_after,
)
from localizer.registration.anchors import apply_sweep
from localizer.registration.jngo import JNGO
from localizer.registration.priors import PoseConstraint
from localizer.registration.result import Registration
from localizer.types import GroundUncertainty, PosePrior

_CHI2_95 = 5.991  # two degrees of freedom


class VisualOdometry:
    """Registers each frame against a keyframe, by the map registration's features and optimizer.

    While the map matches, call `begin` with every accepted frame; it only stores its arguments.
    When the map does not match, call `step` with every frame. It takes one registration, and a few
    milliseconds more for a new keyframe. Both belong to the localization thread. The odometry
    renders nothing and starts no thread.

    camera: the working pinhole of features whose frame names none. ground: a terrain model for
    where the map has no geometry. Only its shape is used: it is shifted vertically to the ground
    where the map was last seen. None: a plane at the height measured by a rangefinder, else at the
    ground height where the map was last seen. uncertainty: of that ground.

    Above 200 lines: the path of one frame, from keyframe to estimate, over one state.
    """

    def __init__(
        self,
        camera: Camera,
        optimizer: JNGO,
        config: OdometryConfig | None = None,
        ground: TerrainModel | None = None,
        seed: int = 0,
        uncertainty: GroundUncertainty | None = None,
    ) -> None:
        self._uncertainty = uncertainty or GroundUncertainty()
        self._camera = camera
        self._optimizer = optimizer
        self.config = config or OdometryConfig()
        self._ground = self._terrain = ground
        self._plane: TerrainModel | None = None
        self._surface: Array | None = None  # that the plane lies under
        self._last_seen = np.zeros(3)  # the middle of the map's surfaces that the plane lies under
        self._sounded = RangefinderGround()
        self._seed = seed
        self._beginning: OdometryStart | None = None
        self._keyframe: Keyframe | None = None
        self._track: OdometryTrack | None = None

    @property
    def ready(self) -> bool:
        """Whether there is a start pose for `step`."""
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
        """Set a frame with a known pose, from the map or from the last fix before the loss.

        pose: world_from_camera, with its covariance (6, 6) as `PosePrior`'s. velocity: (3,) m/s,
        world axes; None: zero. surface: (N, 3) world points of the map's surfaces there, the
        anchors of the reference that it was registered against. constraint: as for `step`, at this
        frame's time; its difference from the pose is taken as the sensors' constant error and
        corrected in every step. This call is cheap; the first `step` makes a keyframe of the frame.
        Earlier odometry is discarded.
        """
        self._beginning = OdometryStart(frame, pose, covariance, surface, constraint)
        self._keyframe = None
        speed = np.zeros(3) if velocity is None else np.asarray(velocity, dtype=np.float64)
        aided, corrected = aided_rotation(constraint), self._beginning.corrected(constraint)
        self._track = OdometryTrack(
            pose, covariance, speed, frame.time_ns, 0.0, aided, corrected, np.zeros((6, 6))
        )
        least = self._optimizer.config.min_anchors
        if surface is not None and surface is not self._surface and len(surface) > least:
            self._surface = surface
            self._plane, self._last_seen = FlatGround.under(surface), surface.mean(axis=0)
            if self._terrain is not None:
                self._ground = RaisedGround.onto(self._terrain, surface)

    def forget(self) -> None:
        """Reset; `step` needs a new `begin`."""
        self._beginning = self._keyframe = self._track = None

    def step(
        self,
        frame: OdometryFrame,
        prediction: PosePrior | None = None,
        *,
        surface: Array | Callable[[], Array | None] | None = None,
        constraint: PoseConstraint | None = None,
        clearance_m: float | None = None,
    ) -> OdometryEstimate:
        """Estimate the pose of the next frame.

        prediction: of the motion model at the frame's time, updated with the last estimates of this
        odometry; None: constant velocity, with the rotation of the constraint. surface: (N, 3)
        world points of the map's surfaces in view: the anchors of the reference that was rendered
        for this frame, None where the map has no geometry, or a function that returns them, called
        for a new keyframe. constraint: the autopilot's data at the frame's time
        (`registration.priors`): height by the barometer, roll and pitch, heading with the compass's
        real error; `combine` them. clearance_m: the height above the surface below, by a
        rangefinder.

        If the status is not OK, do not use the pose. Once it is LOST, only `begin` helps.
        `OdometryError` before `begin`, and if nothing gives the first keyframe a depth.
        """
        beginning, track = self._beginning, self._track
        if beginning is None or track is None:
            raise OdometryError("nothing to carry on from: call begin with a known pose first")
        keyframe = self._keyframe or self._first_keyframe(beginning)
        prior = prediction or track.predict(self.config, frame.time_ns, constraint)
        if (gap := seconds(track.time_ns, frame.time_ns)) > self.config.longest_gap_s:
            return self._failed(
                OdometryStatus.LOST, f"nothing usable for {gap:.1f} s", frame, prior, keyframe
            )
        if frame.fault is not None:
            return self._failed(
                OdometryStatus.UNUSABLE_IMAGE, frame.fault.value, frame, prior, keyframe
            )
        camera = frame.camera or self._camera
        result = self._optimizer.register(
            frame.features,
            camera,
            apply_sweep(keyframe.anchors, frame.sweep, prior.world_from_camera, camera),
            prior,
            motion=prior,
            seed=self._seed + frame.time_ns % 1_000_003,
        )
        predicted = track.since_keyframe(self.config, prior, frame.time_ns, constraint)
        if reason := rejection(self.config, result, keyframe, predicted):
            return self._failed(OdometryStatus.NOT_REGISTERED, reason, frame, prior, keyframe)
        sensed = (constraint, beginning.corrected(constraint))
        after = track_after(self.config, track, keyframe, result, frame.time_ns, sensed)
        if clearance_m is not None:
            self._sounded.add(frame.time_ns, float(after.pose.translation[2]) - clearance_m)
        spent = self._is_spent(keyframe, result, after)
        if spent:
            after = self._aligned(keyframe, frame, after)
        self._track = after
        estimate = self._estimate(
            OdometryStatus.OK, "", frame.time_ns, after, keyframe, after.pose, result.quality
        )
        if spent:
            self._hand_over(frame, after, surface() if callable(surface) else surface)
        return estimate

    def _first_keyframe(self, beginning: OdometryStart) -> Keyframe:
        constraint = beginning.corrected(beginning.constraint)
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
        ground, below = self._below(frame.time_ns)
        camera = frame.camera or self._camera
        anchors, source = keyframe_anchors(
            frame.features, camera, pose, surface, ground,
            self.config.anchors, self._seed, frame.sweep,
        )  # fmt: skip
        source = below if source is DepthSource.GROUND else source
        if len(anchors.points_world) < 2 * self._optimizer.config.min_anchors:
            return None
        before = (
            np.zeros((3, 3)) if self._keyframe is None else self._keyframe.scale_covariance_at(pose)
        )
        place = covariance[:3, :3] + before
        scale = self._scale_sigma(source, anchors.points_world, pose.translation, place)
        return Keyframe(
            anchors, pose, covariance, frame.time_ns, source, way_m, frame.features, camera,
            surface if source is DepthSource.MAP else None, constraint, scale, before,
        )  # fmt: skip

    def _scale_sigma(
        self, source: DepthSource, points_world: Array, place: Array, covariance: Array
    ) -> float:
        """Relative sigma of the height above the ground. place: (3,), with its covariance."""
        base, ground = growth_of(self.config, source).scale, self._uncertainty
        if source is DepthSource.RANGE:
            return base
        above_m, sigma_m = height_above_ground(points_world, covariance, place)
        away = (points_world.mean(axis=0) - self._last_seen)[:2]
        away_m = float(np.sqrt(away @ away + np.trace(covariance[:2, :2])))
        unknown_m = {
            DepthSource.MAP: ground.missing_m,
            DepthSource.GROUND: ground.model_m,
            DepthSource.PLANE: ground.grade * away_m,
        }[source]
        return float(np.hypot(base, np.hypot(sigma_m, unknown_m) / above_m))

    def _below(self, time_ns: int) -> tuple[TerrainModel | None, DepthSource]:
        """The ground where the map has none, and the source of its height."""
        if self._ground is not None:
            return self._ground, DepthSource.GROUND
        if (sounded := self._sounded.at(time_ns)) is not None:
            return sounded, DepthSource.RANGE
        return self._plane, DepthSource.PLANE

    def _aligned(
        self, keyframe: Keyframe, frame: OdometryFrame, track: OdometryTrack
    ) -> OdometryTrack:
        """The track, recomputed from the keyframe's pose by parallax over the map's shape."""
        noise = self.config.parallax_noise
        is_fine = frame.features.levels[-1].stride == 1  # nothing else shows a parallax of a pixel
        if keyframe.surface is None or noise is None or not is_fine:
            return track
        found = align(
            self._optimizer.backend,
            ParallaxView(keyframe.features, keyframe.world_from_camera, keyframe.camera),
            ParallaxView(frame.features, track.pose, frame.camera or self._camera),
            keyframe.surface,
            keyframe.covariance,
            noise,
        )
        if found is None:
            return track
        lever = found.second.translation - found.first.translation
        covariance = transferred(found.covariance, lever) + track.relative
        return replace(track, pose=found.second, covariance=covariance)

    def _hand_over(self, frame: OdometryFrame, track: OdometryTrack, surface: Array | None) -> None:
        """Make the frame the keyframe, unless too little of it has depth."""
        made = self._make_keyframe(
            frame, track.pose, track.covariance, track.way_m, surface, track.constraint
        )
        if made is not None:
            self._keyframe = replace(made, unmatched_m2=track.unmatched_m2)
            self._track = replace(track, best=0.0, relative=np.zeros((6, 6)))

    def _is_spent(self, keyframe: Keyframe, result: Registration, track: OdometryTrack) -> bool:
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
        """The prediction, with the error that may have grown since the last usable frame."""
        assert self._track is not None
        dt = seconds(self._track.time_ns, frame.time_ns)
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
        track: OdometryTrack,
        keyframe: Keyframe,
        pose: Pose,
        quality: float,
    ) -> OdometryEstimate:
        assert self._beginning is not None
        begun = self._beginning
        covariance = track.covariance + np.diag([track.unmatched_m2] * 2 + [0.0] * 4)
        covariance[:3, :3] += keyframe.scale_covariance_at(pose)
        known = transferred(begun.covariance, pose.translation - begun.pose.translation)
        added = np.linalg.eigvalsh((covariance - known)[:2, :2])[-1]
        return OdometryEstimate(
            pose, covariance, quality, status, reason, time_ns,
            bridged_s=seconds(begun.frame.time_ns, time_ns),
            way_m=track.way_m,
            drift_m=float(np.sqrt(_CHI2_95 * max(added, 0.0))),
            keyframe_age_s=seconds(keyframe.time_ns, time_ns),
            source=keyframe.source,
            scale_sigma=keyframe.scale,
        )  # fmt: skip
