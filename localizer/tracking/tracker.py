"""State shared by both threads: motion, track status, and the test of registrations."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace

from localizer.config import LocalizerConfig
from localizer.geometry.pose import so3_log
from localizer.geometry.shutter import Sweep
from localizer.integrity.acceptance import is_acceptable
from localizer.integrity.confirmation import IndependentEvidence
from localizer.registration.result import Registration
from localizer.tracking import motion
from localizer.tracking.dead_reckoning import DeadReckoning, PropagatedPose, PropagationResult
from localizer.tracking.motion import AuxiliarySensors, MotionState
from localizer.tracking.rejoining import Rejoining
from localizer.tracking.sensor_fusion import FusedRegistration
from localizer.tracking.states import RegistrationOutcome, TrackStatus, next_status
from localizer.types import (
    Anchors,
    FeaturePyramid,
    Frame,
    PoseEstimate,
    PosePrior,
    RegistrationStatus,
    TrackingState,
)

_LEAST_RATE_NS = 15_000_000  # to both sides of an exposure: sensors report every 20 ms


@dataclass(frozen=True)
class TrackerState:
    """State of both threads; immutable, replaced as one object. motion: None without a prior."""

    motion: MotionState | None = None
    track_status: TrackStatus = field(default_factory=TrackStatus)


class Tracker:
    """Tests registrations, filters the motion, and propagates the pose without the map.

    `update` belongs to the localization thread; other methods may be called from any thread.
    dead_reckoning: None: without odometry.
    """

    def __init__(
        self,
        config: LocalizerConfig,
        sensors: AuxiliarySensors,
        dead_reckoning: DeadReckoning | None,
    ) -> None:
        self._config = config
        self._sensors = sensors
        self._dead_reckoning = dead_reckoning
        self._rejoining = Rejoining()
        self._lock = threading.Lock()
        self._state = TrackerState()

    @property
    def state(self) -> TrackerState:
        """The current motion state and track status."""
        with self._lock:
            return self._state

    def set_prior(self, prior: PosePrior) -> None:
        """Start (again) from an external pose: INITIALIZING, with the prior's motion."""
        state = motion.start(prior, self._config.motion)
        with self._lock:
            self._state = TrackerState(state, self._state.track_status.restarted())

    def propose(self, prior: PosePrior) -> None:
        """Start a tentative track with the prior's motion; the `TrackingState` does not change."""
        state = motion.start(prior, self._config.motion)
        with self._lock:
            self._state = TrackerState(state, self._state.track_status.proposed(prior.independent))

    def predict(self, time_ns: int) -> PosePrior | None:
        """The motion model's prediction; None before the first prior."""
        state = self.state.motion
        if state is None:
            return None
        turn = self._sensors.turn(state.time_ns, time_ns)
        return motion.predict(state, time_ns, self._config.motion, turn).prior

    def at_frame(self, seen: TrackerState, time_ns: int) -> MotionState | None:
        """The motion of `seen`, extrapolated to a frame's exposure; None before the first prior.

        For an exposure before that motion's time (the camera's clock jumped) the pose is kept, its
        sigmas are those of a search, and the velocity is unknown.
        """
        state = seen.motion
        if state is None:
            return None
        turn = self._sensors.turn(state.time_ns, time_ns)
        # Back in time its velocity would move the state the wrong way.
        move = motion.predict if time_ns >= state.time_ns else motion.reset_motion
        return move(state, time_ns, self._config.motion, turn)

    def sweep(self, frame: Frame, ahead: MotionState) -> Sweep | None:
        """The camera's motion while a rolling shutter reads the frame; None for a global shutter.
        ahead: the motion at the frame's exposure. The rotation comes from the other sensor, if its
        data surround the exposure; otherwise from the motion model.
        """
        readout_ms = frame.camera.readout_ms
        if readout_ms <= 0:
            return None
        half_ns = max(round(0.5e6 * readout_ms), _LEAST_RATE_NS)
        turn = self._sensors.turn(ahead.time_ns - half_ns, ahead.time_ns + half_ns)
        rate = ahead.rate if turn is None else so3_log(turn) / (2e-9 * half_ns)
        return Sweep.of(rate, ahead.velocity, readout_ms)

    def update(
        self,
        seen: TrackerState,
        ahead: MotionState,
        frame: Frame,
        query: FeaturePyramid,
        anchors: Anchors | None,
        fused: FusedRegistration | None,
    ) -> PoseEstimate:
        """Test a registration, update motion and track status, and run the odometry: it restarts at
        an accepted frame and propagates the pose over a rejected one.

        seen, ahead: the state and its motion at the frame, from which the registration started; if
        an external prior has replaced that state since, the new motion and status are dropped.
        query: the frame's features. anchors, fused: None without a reference view.
        """
        result = None if fused is None else fused.registration
        acceptable = result is not None and self._is_acceptable(result, ahead.prior)
        if fused is not None and fused.contradicted and seen.track_status.tentative:
            acceptable = False  # gravity and height are evidence that the search did not use
        carried = self._carry(seen, ahead, frame, query, anchors, acceptable)
        rejoins = not acceptable and self._rejoins(seen.track_status, result, carried, frame)
        acceptable = acceptable or rejoins
        if result is not None:
            measured, covariance = result.world_from_camera, result.covariance
        else:
            measured, covariance = ahead.prior.world_from_camera, ahead.prior.covariance
        outcome = RegistrationOutcome(
            acceptable, measured, covariance, frame.exposure_time_ns, carried.status,
            motion.is_beyond_capture(ahead.prior),
            result is not None or carried.status is not PropagationResult.NONE,
        )  # fmt: skip
        evidence = self._evidence(seen.track_status, outcome)
        track_status = next_status(seen.track_status, self._config.integrity, outcome, evidence)
        bridges = track_status.state is TrackingState.BRIDGING
        lost = track_status.state is TrackingState.LOST
        moved = self._next_motion(ahead, result, acceptable and not bridges, carried, lost)
        if rejoins and not bridges and result is not None:  # the prediction was of the wrong place
            moved = motion.start(_restart(result, ahead), self._config.motion)
        self._store(seen, moved, track_status)
        estimate = _estimate(frame, outcome, result, carried, track_status)
        is_fix = estimate.accepted and not bridges
        if is_fix:
            # Position and tilt err together, from frame to frame again; the turn between two frames
            # is known several times better. The sigmas told stay the registration's: the map errs
            # alike for seconds, which a filter takes for knowledge.
            estimate = replace(estimate, world_from_camera=moved.prior.world_from_camera)
        if is_fix and self._dead_reckoning is not None and anchors is not None:
            swept = self.sweep(frame, ahead)
            self._dead_reckoning.begin(estimate, query, anchors, moved.velocity, swept)
        return estimate

    def _is_acceptable(self, result: Registration, prior: PosePrior) -> bool:
        # Also before tracking: the gate is against the prior's own covariance, which is wide then.
        distance = prior.mahalanobis_squared(result.world_from_camera, result.covariance)
        sigma_m = motion.horizontal_sigma_m(prior)
        return is_acceptable(self._config.integrity, result, distance, sigma_m)

    def _carry(
        self, seen: TrackerState, ahead: MotionState, frame: Frame, query: FeaturePyramid,
        anchors: Anchors | None, acceptable: bool,
    ) -> PropagatedPose:  # fmt: skip
        """The odometry's result: for frames that the map rejected, and until it has confirmed."""
        track_status = seen.track_status
        wanted = not acceptable or track_status.state is TrackingState.BRIDGING
        if self._dead_reckoning is None or not track_status.trusts_prediction or not wanted:
            return PropagatedPose(PropagationResult.NONE)
        swept = self.sweep(frame, ahead)
        return self._dead_reckoning.propagate(frame, query, ahead.prior, anchors, swept)

    def _rejoins(
        self,
        track_status: TrackStatus,
        result: Registration | None,
        carried: PropagatedPose,
        frame: Frame,
    ) -> bool:
        """Whether registrations that the acceptance test rejects refute the propagated pose."""
        pose = carried.world_from_camera
        good = result is not None and is_acceptable(self._config.integrity, result, 0.0)
        if track_status.state is not TrackingState.BRIDGING or result is None or not good:
            self._rejoining = Rejoining()
            return False
        if pose is None:  # a gap of the odometry says nothing of the map's answers
            return False
        rotation = self._sensors.rotation_at(frame.exposure_time_ns)
        self._rejoining = self._rejoining.with_registration(
            result.world_from_camera, result.covariance, frame.exposure_time_ns, pose, rotation,
            self._config.integrity,
        )  # fmt: skip
        return self._rejoining.confirmed

    def _evidence(
        self, track_status: TrackStatus, outcome: RegistrationOutcome
    ) -> IndependentEvidence:
        """Evidence of other sensors about a tentative position."""
        if not track_status.tentative or not outcome.acceptable:
            return IndependentEvidence()
        rotation = self._sensors.rotation_at(outcome.time_ns)
        if track_status.tentative_track is None:
            return IndependentEvidence(rotation)
        begun_ns = track_status.tentative_track.time_ns
        way = self._sensors.displacement_between(begun_ns, outcome.time_ns)
        return IndependentEvidence(rotation, way)

    def _next_motion(
        self, ahead: MotionState, result: Registration | None, use_map: bool,
        carried: PropagatedPose, lost: bool,
    ) -> MotionState:  # fmt: skip
        if use_map and result is not None:
            noise = result.covariance if result.noise is None else result.noise
            return motion.update(ahead, result.world_from_camera, noise)
        if carried.world_from_camera is not None and carried.covariance is not None:
            return motion.update(ahead, carried.world_from_camera, carried.covariance)
        if result is not None and is_acceptable(self._config.integrity, result, 0.0):
            return motion.inflate(ahead, self._config.motion)
        if lost:  # its velocity is of long ago, and would carry the search out of the map
            return motion.reset_motion(ahead, ahead.time_ns, self._config.motion, None)
        return ahead

    def _store(self, seen: TrackerState, state: MotionState, track_status: TrackStatus) -> None:
        """Store the new state unless an external prior replaced it meanwhile."""
        with self._lock:
            if self._state is seen:
                self._state = TrackerState(state, track_status)


def _restart(result: Registration, ahead: MotionState) -> PosePrior:
    """Prior at the map's registration, with the velocity that the odometry measured."""
    return PosePrior(
        result.world_from_camera, result.covariance, ahead.time_ns, ahead.velocity.copy()
    )


def _estimate(
    frame: Frame,
    outcome: RegistrationOutcome,
    result: Registration | None,
    carried: PropagatedPose,
    track_status: TrackStatus,
) -> PoseEstimate:
    """The published pose of a frame, from the map or from the odometry."""
    status = result.status if result is not None else RegistrationStatus.NO_OVERLAP
    bridges = track_status.state is TrackingState.BRIDGING
    estimate = PoseEstimate(
        outcome.world_from_camera,
        outcome.covariance,
        result.quality if result is not None and status is RegistrationStatus.OK else 0.0,
        track_status.state,
        status,
        accepted=outcome.acceptable and not bridges and not track_status.tentative,
        exposure_time_ns=frame.exposure_time_ns,
        sequence=frame.sequence,
        camera=frame.camera,
        last_fix_ns=track_status.last_fix_ns,
    )
    pose, covariance = carried.world_from_camera, carried.covariance
    if not bridges or pose is None or covariance is None:
        return estimate
    return replace(
        estimate, world_from_camera=pose, covariance=covariance, quality=carried.quality,
        status=RegistrationStatus.OK, accepted=True, scale_sigma=carried.scale_sigma,
    )  # fmt: skip
