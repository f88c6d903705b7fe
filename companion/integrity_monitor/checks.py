"""All checks of the integrity monitor: evidence in, alerts out. No threads and no clock."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from companion.calibration_watch.observation import (
    CalibrationEstimate,
    CalibrationObservation,
    GroundView,
)
from companion.calibration_watch.watch import BORESIGHT_DEG, FOCAL_SHARE, TIME_S, CalibrationWatch
from companion.inertial import InertialTrack
from companion.integrity_monitor.config import IntegrityMonitorConfig
from companion.integrity_monitor.debouncer import ActiveAlerts, AlertDebouncer, CheckResult
from companion.integrity_monitor.jump import JumpCheck
from companion.integrity_monitor.motion import CALM_SHARE, MotionCheck, MotionVerdict, ScaleCheck
from companion.integrity_monitor.position_checks import EkfWatch, GnssCheck, HeightCheck, TiltCheck
from companion.integrity_monitor.protection import ProtectionLevel, protection_level
from companion.integrity_monitor.step import StepUncertainty
from companion.integrity_monitor.video import (
    LOW_DETAIL,
    REPEAT_S,
    STILL_SHARE,
    FrameVerdict,
    FrozenVideoDetector,
)
from localizer.types import Image
from mavlink_bridge.alerts.alert import Alert, Inhibits, OutputAction
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.integrity import INTEGRITY
from mavlink_bridge.alerts.words import CalibrationError
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.messages import Attitude, VehicleState, VisionFix

_AIRBORNE_M = 3.0
_IDENTICAL_S = 1.5
_STILL_S = 3.0  # time after which a frozen frame is reported
_STILL_PER_M = 90.0  # s/m: how much longer where the limit is more metres on the ground
_STILL_FIRST_S = 2.0
_MOVED_M, _MOVED_SPEED_MPS, _MOVED_LEAST_S = 2.0, 1.5, 0.35
_REPEATS_BEFORE_S = 1.5  # by which a loop may be older than its finding, beyond `repeat_s`
_SHOWS_GRAY = 2.0  # contrast below which a picture shows nothing, gray levels of 255
_WAITS_NS = 500_000_000  # for the IMU's record to reach a fix
_FRESH_NS = 1_000_000_000
_PICTURE_FRESH_NS = 2_000_000_000
_OLD_NS = 2_000_000_000  # of a velocity, which comes ten times a second
_BACKWARDS = 5  # pictures or fixes in a row whose stamps do not advance
_QUEUE = 256


@dataclass(frozen=True)
class IntegrityLimits:
    """Settings from other parts of the configuration. gnss_is_ours: the vehicle's GNSS input is our
    GPS_INPUT, so that it is no independent evidence; horizontal_fov_deg: of the camera.
    """

    alert_limit_m: float = 10.0
    time_to_alert_s: float = 3.0
    gnss_is_ours: bool = False
    horizontal_fov_deg: float = 60.0


class IntegrityChecks:
    """Holds the checks and their alerts. Call every method under one lock, or from one thread.
    track: the IMU's integrated acceleration.

    Above 200 lines: a few lines for each check pass its evidence to it and take its result.
    """

    def __init__(
        self,
        config: IntegrityMonitorConfig,
        limits: IntegrityLimits,
        track: InertialTrack | None = None,
    ) -> None:
        self._protection, self._limits = config.protection, limits
        self._pictures = FrozenVideoDetector()
        self._track = track or InertialTrack()
        self._motion = MotionCheck(self._track)
        self._scale = ScaleCheck(self._track)
        self._height = HeightCheck()
        self._gnss = GnssCheck()
        self._jumps = JumpCheck()
        self._steps = StepUncertainty()
        self._tilt = TiltCheck()
        self._ekf = EkfWatch()
        self._calibration = CalibrationWatch()
        self._ground = GroundView(limits.horizontal_fov_deg)
        specs = {spec.id: spec for spec in INTEGRITY}
        limit = specs[AlertId.HPL_OVER_LIMIT]
        raise_s = min(limit.raise_s, limits.time_to_alert_s)
        specs[limit.id] = replace(limit, raise_s=raise_s)
        self._debouncers = {of: AlertDebouncer(spec) for of, spec in specs.items()}
        self._picture: tuple[int, FrameVerdict] | None = None
        self._verdict: MotionVerdict | None = None
        self._height_reading = CheckResult(None)
        self._waiting: deque[tuple[VisionFix, bool]] = deque(maxlen=_QUEUE)
        self._newest: VisionFix | None = None
        self._level: ProtectionLevel | None = None
        self._jump_held = False
        self._wrong = 0  # fixes withheld as wrong: after each the next one that passes is a jump
        self._backwards = 0

    # --- what there is ------------------------------------------------------------------------

    @property
    def action(self) -> OutputAction:
        """The strongest action of all active alerts."""
        return max((one.spec.action for one in self._active()), default=OutputAction.NONE)

    @property
    def reason(self) -> Alert | None:
        """Alert that holds the output; None while it is not held."""
        action = self.action
        held = (one for one in self._active() if one.spec.action is action)
        return next(held).alert() if action is not OutputAction.NONE else None

    @property
    def inhibiting(self) -> frozenset[AlertId]:
        """The active alerts that inhibit something, see `Inhibits`."""
        return frozenset(one.spec.id for one in self._active() if one.spec.inhibits)

    def to_remember(self) -> ActiveAlerts:
        """The active calibration alerts that inhibit injection, to be restored after a restart."""
        return {
            one.spec.id: (one.figure, one.word)
            for one in self._active()
            if Inhibits.INJECTION in one.spec.inhibits and isinstance(one.word, CalibrationError)
        }

    def _active(self) -> list[AlertDebouncer]:
        return [debouncer for debouncer in self._debouncers.values() if debouncer.raised]

    @property
    def _is_only_uncertain(self) -> bool:
        """Whether only the protection level holds the output: position changes are valid then."""
        holding = {one.spec.id for one in self._active() if one.spec.action >= OutputAction.HOLD}
        return holding == {AlertId.HPL_OVER_LIMIT}

    def restore(self, found: ActiveAlerts) -> None:
        """Activate alerts of the process before a restart; evidence clears them as usual."""
        for of, (figure, word) in found.items():
            self._debouncers[of].restore(figure, word)

    @property
    def level(self) -> ProtectionLevel | None:
        """Protection level of the newest fix; None before the first."""
        return self._level

    def active_values(self) -> dict[str, float]:
        """The active alerts by identifier, with their values (0.0 if an alert has none)."""
        return {one.spec.id.value: one.figure for one in self._active()}

    # --- evidence -----------------------------------------------------------------------------

    def add_frame(self, time_ns: int, image: Image) -> None:
        """Add a frame (H, W, 3) uint8 at its exposure time (ns), for the video checks. One that is
        not later than the last counts only as a fault of the timestamps.
        """
        if self._picture is not None and time_ns <= self._picture[0]:
            self._backwards += 1
            return
        self._backwards = 0
        self._picture = (time_ns, self._pictures.add(time_ns, image))

    def add_observation(self, observation: CalibrationObservation) -> None:
        """Add a registered frame, for the calibration watch and the height above the ground."""
        self._calibration.add(observation)
        self._ground.add(observation)

    def admit(
        self,
        fix: VisionFix,
        state: VehicleState,
        attitude: Attitude | None = None,
        *,
        held: bool = False,
    ) -> VisionFix | None:
        """Return a fix, with protection level and covariance completed, if it may be injected; None
        holds it. Call it once for each fix, in time order: it is evidence for `step`, too.

        Its reset count is increased if earlier fixes were wrong. A fix of the odometry that only
        its protection level holds is marked `position_withheld`; each fix of the odometry gets the
        scale error that the IMU has shown. attitude: the autopilot's at the fix's time, None if
        unknown; held: whether another check holds the fix.
        """
        self._tilt.add(fix, attitude)
        verdict = self._verdict
        agrees = verdict is None or not verdict.settled or verdict.share < CALM_SHARE
        admitted = self._jumps.admit(fix, state, attitude, agrees=agrees)
        self._update_steps(fix, state, admitted=admitted)
        height_m = self._ground.height_m(state, fix.time_ns)
        position_error_m = self._estimated_error_m(state, height_m)
        moving = _moving_now(state, fix.time_ns)
        self._level = level = protection_level(
            fix, moving, self._protection, position_error_m, height_m
        )
        scale = None if fix.scale_sigma is None else max(fix.scale_sigma, self._scale.scale_error)
        levels = (level.horizontal_m, level.vertical_m)
        fix = replace(fix, protection_m=levels, scale_sigma=scale)
        self._jump_held = not admitted
        # The jump has a line of its own; how the place moves after it is judged again.
        before, self._newest = self._newest, fix
        jumped = before is not None and fix.reset_count != before.reset_count
        self._waiting.append((fix, self._jumps.jumped or jumped))
        if self.action >= OutputAction.HOLD or not admitted:
            self._wrong += self._jump_held or self.action is OutputAction.EXCLUDE_AND_RESET
            moves_right = fix.by_odometry and admitted and not held and self._is_only_uncertain
            if not moves_right:
                return None
            return replace(fix, position_withheld=True)
        if held:
            return None
        # The EKF must not believe what is known to be off to what noise alone would leave. The
        # checks above keep the noise: what they look for is what it does not explain.
        covariance = fix.position_covariance_ned + position_error_m**2 * np.eye(3)
        resets = fix.reset_count + self._wrong
        return replace(fix, reset_count=resets, position_covariance_ned=covariance)

    def step(self, now_ns: int, vehicle: Bridge) -> list[Alert]:
        """Run all checks, a few times a second; returns the alerts to report, raised or cleared."""
        state = vehicle.state()
        self._track.follow(vehicle)
        self._jumps.add_state(state)
        self._follow(now_ns, state)
        self._exclude_stale_frames()
        self._calibration.step(now_ns, vehicle, self._track)
        results = self._results(now_ns, _moving_now(state, now_ns))
        updates = (one.update(now_ns, results[of]) for of, one in self._debouncers.items())
        return [alert for alert in updates if alert is not None]

    def _update_steps(self, fix: VisionFix, state: VehicleState, *, admitted: bool) -> None:
        """Update the uncertainty from position steps. admitted: the jump check passed the fix."""
        if not state.armed:
            self._steps.reset()
        elif self._jumps.announced and admitted:
            self._steps.confirm_position()
        elif self._jumps.step is not None:
            found = self._steps.add(self._jumps.step)
            if found is not None:
                self._calibration.suspect_timestamps(found.time_ns)
        no_delay_s = max(TIME_S, 0.5 * self._steps.delay_s)
        if self._calibration.figures().late_s.is_within(no_delay_s):
            self._steps.confirm_timestamps()

    def _exclude_stale_frames(self) -> None:
        """Exclude frozen or repeated frames from the calibration watch: without motion they look
        like late timestamps.
        """
        if self._picture is None:
            return
        time_ns, verdict = self._picture
        if verdict.repeat_lag_s > 0.0 or self._debouncers[AlertId.VIDEO_REPEATS].raised:
            found_s = REPEAT_S + _REPEATS_BEFORE_S
            self._calibration.exclude_since(time_ns - int(found_s * 1e9))
        elif verdict.still_s >= _IDENTICAL_S or self._debouncers[AlertId.VIDEO_FROZEN].raised:
            self._calibration.exclude_since(time_ns - int(verdict.still_s * 1e9))

    def _follow(self, now_ns: int, state: VehicleState) -> None:
        """Process the fixes whose time the IMU record has reached, in order."""
        while self._waiting:
            fix, jumped = self._waiting[0]
            if not self._motion.ready(fix) and now_ns - fix.time_ns < _WAITS_NS:
                return
            self._waiting.popleft()
            self._verdict = self._motion.add(fix, jumped=jumped)
            self._scale.add(fix, jumped=jumped)
            self._height_reading = self._height.add(fix, state)

    # --- judgement ----------------------------------------------------------------------------

    def _results(self, now_ns: int, state: VehicleState) -> dict[AlertId, CheckResult]:
        """The result of each check at now_ns; `bad` is None without evidence."""
        newest = self._newest
        fresh = newest is not None and now_ns - newest.time_ns < _FRESH_NS
        height = state.altitude_relative_m
        # It may fly below its take-off height, from a hill.
        flies = state.armed and (height is None or abs(height) >= _AIRBORNE_M)
        none, good = CheckResult(None), CheckResult(False)
        return {
            AlertId.VIDEO_FROZEN: self._frozen(now_ns, state) if flies else good,
            AlertId.LOW_CONTRAST: self._low_contrast(now_ns) if flies else good,
            AlertId.VIDEO_REPEATS: self._repeats(now_ns) if flies else good,
            AlertId.VISION_IMU_MISMATCH: self._moves_otherwise() if fresh else none,
            AlertId.HEIGHT_MISMATCH: self._height_reading if fresh else none,
            AlertId.POSITION_JUMP: CheckResult(self._jump_held, self._jumps.distance_m),
            AlertId.POSITION_STEP: CheckResult(self._steps.metres > 0.0, self._steps.metres),
            AlertId.TILT_MISMATCH: self._tilt_mismatch() if fresh else none,
            AlertId.GNSS_VISION_MISMATCH: self._gnss_mismatch(state, now_ns) if fresh else none,
            AlertId.EKF_REJECTS_VISION: self._ekf.check_rejection(state) if fresh else good,
            AlertId.EKF_JUMP: self._ekf_jump(state, now_ns),
            AlertId.VIDEO_TIMESTAMPS: CheckResult(self._backwards >= _BACKWARDS),
            AlertId.HPL_OVER_LIMIT: self._level_over_limit() if fresh else none,
            **self._calibration_results(),
        }

    def _calibration_results(self) -> dict[AlertId, CheckResult]:
        known = self._calibration.figures()
        share, late = known.focal, known.late_s
        long = CalibrationError.LONG if share.value > 0.0 else CalibrationError.SHORT
        when = CalibrationError.LATE if late.value > 0.0 else CalibrationError.EARLY
        return {
            AlertId.FOCAL_LENGTH: _beyond(share, FOCAL_SHARE, 100.0, long),
            AlertId.BORESIGHT: _beyond(known.boresight_deg, BORESIGHT_DEG, 1.0, known.axis),
            AlertId.TIME_OFFSET: _beyond(late, TIME_S, 1e3, when),
        }

    def _estimated_error_m(self, state: VehicleState, height_m: float | None) -> float:
        """Position error from estimated calibration, steps and tilt, m. height_m: above ground."""
        speed = math.hypot(*(state.local_velocity_ned or (0.0, 0.0, 0.0))[:2])
        focal, late = (
            self._debouncers[AlertId.FOCAL_LENGTH].raised,
            self._debouncers[AlertId.TIME_OFFSET].raised,
        )
        focal_m = self._calibration.position_error_m(speed, focal=focal, time=False)
        late_m = self._calibration.position_error_m(speed, focal=False, time=late)
        # Late stamps are how a step is explained, and a tilt shifts as a step does.
        return focal_m + max(late_m, self._steps.possible_m, self._tilt.metres(height_m))

    def _fresh_verdict(self, now_ns: int) -> FrameVerdict | None:
        """Of the newest frame; None for an old one, since a feed that ended is reported as such."""
        if self._picture is None or now_ns - self._picture[0] > _PICTURE_FRESH_NS:
            return None
        return self._picture[1]

    def _frozen(self, now_ns: int, state: VehicleState) -> CheckResult:
        verdict = self._fresh_verdict(now_ns)
        if verdict is None:
            return CheckResult(None)
        if verdict.contrast < _SHOWS_GRAY:
            return CheckResult(False)  # fog, a covered lens: the localizer says it sees nothing
        identical = verdict.identical_s >= _IDENTICAL_S
        still = verdict.still_s >= self._still_s(now_ns, state)
        still = still or self._should_have_moved(state, verdict)
        return CheckResult(identical or still, verdict.still_s)

    def _low_contrast(self, now_ns: int) -> CheckResult:
        verdict = self._fresh_verdict(now_ns)
        if verdict is None:
            return CheckResult(None)
        return CheckResult(verdict.detail < LOW_DETAIL, verdict.detail)

    @staticmethod
    def _should_have_moved(state: VehicleState, verdict: FrameVerdict) -> bool:
        """Whether the EKF moved by metres since the frame froze; False in a hover.

        The EKF keeps its speed at first. Only after a second or two it follows the frozen position.
        """
        if state.local_velocity_ned is None or verdict.still_s < _MOVED_LEAST_S:
            return False
        speed = math.hypot(*state.local_velocity_ned[:2])
        return speed >= _MOVED_SPEED_MPS and speed * verdict.still_s >= _MOVED_M

    def _still_s(self, now_ns: int, state: VehicleState) -> float:
        """How long the image of a hover may show no motion, s; longer high above the ground."""
        ground_m = STILL_SHARE * self._ground.width_m(state, now_ns)
        return max(_STILL_S, _STILL_FIRST_S + _STILL_PER_M * ground_m)

    def _repeats(self, now_ns: int) -> CheckResult:
        verdict = self._fresh_verdict(now_ns)
        if verdict is None:
            return CheckResult(None)
        return CheckResult(verdict.repeat_lag_s > 0.0, verdict.repeat_lag_s)

    def _moves_otherwise(self) -> CheckResult:
        verdict = self._verdict
        if verdict is None or not verdict.settled:
            return CheckResult(None)
        if not self._debouncers[AlertId.VISION_IMU_MISMATCH].raised:
            return CheckResult(verdict.share > 1.0, verdict.deviation_m)
        # A filter follows even a frozen position in the end: it must move before it is believed.
        return CheckResult(not verdict.agrees, verdict.deviation_m)

    def _gnss_mismatch(self, state: VehicleState, now_ns: int) -> CheckResult:
        if self._newest is None or self._level is None or self._limits.gnss_is_ours:
            return CheckResult(None)
        return self._gnss.read(self._newest, state, self._level.horizontal_m, now_ns)

    def _tilt_mismatch(self) -> CheckResult:
        return CheckResult(self._tilt.tilts if self._tilt.is_known else None, self._tilt.off_deg)

    def _ekf_jump(self, state: VehicleState, now_ns: int) -> CheckResult:
        verdict = self._verdict
        agrees = verdict is not None and verdict.settled and verdict.agrees
        return self._ekf.check_jump(
            state, now_ns, agrees=agrees and self.action is OutputAction.NONE
        )

    def _level_over_limit(self) -> CheckResult:
        if self._level is None:
            return CheckResult(None)
        level_m = self._level.horizontal_m
        return CheckResult(level_m > self._limits.alert_limit_m, level_m)


def _beyond(
    figure: CalibrationEstimate, limit: float, scale: float, word: CalibrationError
) -> CheckResult:
    """Bad if the estimate `exceeds` the limit, good if it `is_within`, otherwise no evidence.
    scale: to the unit of the alert; word: for the alert.
    """
    bad = figure.exceeds(limit)
    if not bad and not figure.is_within(limit):
        return CheckResult(None)
    return CheckResult(bad, abs(figure.value) * scale, word)


def _moving_now(state: VehicleState, time_ns: int) -> VehicleState:
    """The state with its velocity removed if that is older than 2 s at `time_ns`: an EKF without a
    position stops LOCAL_POSITION_NED, and the last velocity would stay.
    """
    old = time_ns - state.local_time_ns > _OLD_NS
    return replace(state, local_velocity_ned=None) if old else state
