"""Alerts of the integrity monitor, which checks every fix before it is injected."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import AlertSpec, Inhibits, OutputAction, Severity
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import CalibrationError, GnssDisagreement

WARNING, ERROR = Severity.WARNING, Severity.ERROR
_WITHIN = "N + 2 sigma is below the limit for 10 s"
_NOT_STARTED = "injection does not start; running injection continues"
_CALIBRATE = "after landing run `companion calibrate flight` on the record"
_TAKE_OVER = "take over"
_IF_LASTS = "if it lasts, take over"
_ADDED = "now included in covariance and protection level"
_STILL_VELOCITY = "during `bridging` ArduPilot still receives the velocity"

INTEGRITY: tuple[AlertSpec, ...] = (
    AlertSpec(A.VIDEO_FROZEN, ERROR, "video frozen", "video frozen {seconds:.0f} s",
              {"seconds": "s"},
              "in flight, if the image has contrast: identical frames for 1.5 s; or no image "
              "motion over 2 m of flight at 1.5 m/s or more (EKF's velocity), or for 3 s (high "
              "up: 2 s + 0.027 s per metre of ground across the image)",
              "the image moves for 2 s",
              "camera or link repeat a frame: the position stands still",
              _TAKE_OVER, action=OutputAction.EXCLUDE_AND_RESET, clear_s=2.0),
    AlertSpec(A.VIDEO_REPEATS, ERROR, "video repeats", "video repeats, {seconds:.0f} s old",
              {"seconds": "s"},
              "in flight: for 2 s the frames, which move, equal those of N s before (60 s at most)",
              "frames are new for 5 s",
              "the source plays a recording or loop: the position is an old one",
              _TAKE_OVER, action=OutputAction.EXCLUDE_AND_RESET, clear_s=5.0),
    AlertSpec(A.LOW_CONTRAST, WARNING, "low image contrast",
              "low image contrast {gray:.1f}: dark or haze", {"gray": "gray levels"},
              "in flight: for 2 s the local contrast N is below 2.0 gray levels of 255",
              "it is above for 5 s",
              "dark, haze or plain ground: fixes are still sent, but vision will fail soon",
              "increase the exposure; use good GNSS, or fly home",
              raise_s=2.0, clear_s=5.0, repeat_s=60.0),
    AlertSpec(A.VISION_IMU_MISMATCH, ERROR, "vision/IMU mismatch",
              "vision/IMU mismatch {metres:.0f} m", {"metres": "m"},
              "for 0.2 s the fixes' mean distance N from the position that the IMU predicts "
              "exceeds 1.5 m over 1 s, 1.0 m over 3 s or 0.8 m over 10 s (+ 4 sigma + 1.5 sigma "
              "of a fix)",
              "for 5 s N is below half the limit, and the position moves",
              "the position does not move as the vehicle does: it is wrong", _TAKE_OVER,
              action=OutputAction.EXCLUDE_AND_RESET, raise_s=0.2, clear_s=5.0),
    AlertSpec(A.HEIGHT_MISMATCH, ERROR, "height mismatch", "height {metres:.0f} m off barometer",
              {"metres": "m"},
              "armed: in the last 2 min vision's height changed N more or less than the "
              "barometer's; for 2 s N exceeds 8 m + 4 sigma + 16 % of the climb",
              "N is within the limit for 5 s",
              "vision's height is wrong, its position probably too", _TAKE_OVER,
              action=OutputAction.EXCLUDE_AND_RESET, raise_s=2.0, clear_s=5.0),
    AlertSpec(A.POSITION_JUMP, ERROR, "position jump", "position jumped {metres:.0f} m",
              {"metres": "m"},
              "a fix lies N farther from the last one than flight and 4 sigma explain; N is over "
              "3 m, or over 10 m if vision reports that it found the position again",
              "for 5 s the new position moves as the IMU measures (waits up to 60 s if vision's "
              "heading turned and the gyros did not); or a fix lies at the old one",
              "the old or the new position is wrong", f"wait 5 s; {_IF_LASTS}",
              action=OutputAction.EXCLUDE_AND_RESET),
    AlertSpec(A.POSITION_STEP, WARNING, "position step",
              "position step {metres:.0f} m, unexplained", {"metres": "m"},
              "armed: the mean of five fixes is over 1 m from where the five before lead: more "
              "than motion and 4 sigma explain, but less than a jump",
              "disarmed; a step back; for steps along the course: the video's time offset is "
              "measured and too small to explain them; for others (in a hover: all): the position "
              "is found again after `bridging` or `lost`",
              "fixes are sent, but may be wrong by N (sum of all steps, 3 m at most), "
              f"{_ADDED}",
              "keep N more distance to obstacles", repeat_s=60.0),
    AlertSpec(A.TILT_MISMATCH, WARNING, "tilt mismatch", "tilt {degrees:.0f} deg off autopilot",
              {"degrees": "deg"},
              "for 1 s vision's roll and pitch are N off those of gimbal and autopilot: over 3 "
              "sigma (2.7 deg or more)",
              "N is below 2 sigma for 3 s",
              "low over plain ground tilt and shift look alike: fixes are sent, but may be wrong "
              f"by N times height, 3 m at most, {_ADDED}",
              "climb, or fly over buildings and roads", raise_s=1.0, clear_s=3.0,
              repeat_s=60.0),
    AlertSpec(A.GNSS_VISION_MISMATCH, WARNING, "GNSS/vision mismatch",
              "GNSS/vision mismatch {metres:.0f} m", {"metres": "m"},
              "for 2 s GNSS (3D fix) and vision are N apart, more than protection level + 4 times "
              "the receiver's accuracy (1 to 3 m) + 0.2 s times speed; not with message gps_input",
              "N is within the limit for 5 s; without a 3D fix it stays",
              "GNSS or vision is wrong; fixes are still sent",
              "check landmarks; select the right source set", raise_s=2.0,
              clear_s=5.0, repeat_s=10.0),
    AlertSpec(A.EKF_REJECTS_VISION, WARNING, "EKF rejects its position input",
              "EKF rejects its position input ({ratio:.1f})", {"ratio": ""},
              "the test ratio N is above 1 for 2 s, while fixes are made",
              "N is 1 or less, or no fix is made, for 3 s",
              "the EKF does not use its position input (the fixes if its source set is vision, "
              "otherwise GNSS; PX4: either) and drifts",
              _TAKE_OVER, raise_s=2.0, clear_s=3.0, repeat_s=10.0),
    AlertSpec(A.EKF_JUMP, WARNING, "EKF jump", "EKF jumped {metres:.0f} m, unconfirmed",
              {"metres": "m"},
              "armed: the EKF's position steps by N, over 3 m more than its velocity explains",
              "for 10 s fixes move as the IMU measures and are not held; or disarmed",
              "the EKF was reset (by the first fix after *output held*, another source set or "
              "itself) and may be at a wrong position; fixes are sent; `ekf_follows` waits for "
              "the end",
              "check landmarks", inhibits=Inhibits.EKF_OK),
    AlertSpec(A.VIDEO_TIMESTAMPS, ERROR, "video timestamps", "video timestamps not monotonic", {},
              "for 0.5 s no frame, of five or more, has a later timestamp than those before",
              "timestamps increase for 3 s", "the positions' times are wrong",
              f"{_TAKE_OVER}; restart the video source", action=OutputAction.HOLD,
              raise_s=0.5, clear_s=3.0),
    AlertSpec(A.HPL_OVER_LIMIT, ERROR, "HPL over limit", "HPL {metres:.0f} m over limit",
              {"metres": "m"},
              "for 1 s (`bridge.injection.time_to_alert_s`, if less) the horizontal protection "
              "level N is above `bridge.injection.alert_limit_m` (default 10 m)",
              "it is below for 3 s; without fixes it stays",
              f"the position may be wrong by N; {_STILL_VELOCITY}",
              f"fly higher, or over buildings and roads; {_IF_LASTS}",
              action=OutputAction.HOLD, raise_s=1.0, clear_s=3.0),
    AlertSpec(A.FOCAL_LENGTH, WARNING, "focal length", "focal length {percent:.1f} % {direction}",
              {"percent": "%", "direction": CalibrationError},
              "the calibrated focal length proves N too *long* or *short*: for 2 s more than 2.5 "
              "%, and more than 4 sigma", _WITHIN,
              f"positions are wrong by N % of the height above ground, {_ADDED}; {_NOT_STARTED}",
              _CALIBRATE,
              inhibits=Inhibits.INJECTION, raise_s=2.0, clear_s=10.0, repeat_s=60.0),
    AlertSpec(A.BORESIGHT, WARNING, "boresight", "camera {degrees:.0f} deg off in {axis}",
              {"degrees": "deg", "axis": CalibrationError},
              "vision's roll, pitch or yaw differs by N from that of gimbal and autopilot: for 3 s "
              "more than 3 deg, and more than 4 sigma", _WITHIN,
              f"mounting angles, gimbal or compass are wrong; {_NOT_STARTED}",
              _CALIBRATE,
              inhibits=Inhibits.INJECTION, raise_s=3.0, clear_s=10.0, repeat_s=60.0),
    AlertSpec(A.TIME_OFFSET, WARNING, "time offset",
              "video timestamps {milliseconds:.0f} ms {direction}",
              {"milliseconds": "ms", "direction": CalibrationError},
              "vision's motion is N *late* or *early* against the autopilot's: for 1 s more "
              "than 80 ms, and more than 4 sigma",
              _WITHIN,
              "positions are behind (late) or ahead of (early) the vehicle by speed times N, "
              f"{_ADDED}; {_NOT_STARTED}",
              "fly slowly; after landing correct `camera.settings.time_offset_ms` (`companion "
              "calibrate flight`)",
              inhibits=Inhibits.INJECTION, raise_s=1.0, clear_s=10.0, repeat_s=60.0),
)  # fmt: skip
MONITOR: tuple[AlertSpec, ...] = (
    AlertSpec(A.MONITOR_FAILED, ERROR, "integrity monitor failed", "integrity monitor failed", {},
              "a check fails by a program fault, or the monitor's thread does not run for 2 s",
              "all checks run for 3 s",
              "no position is sent while the thread does not run, or once checks have failed for "
              "1 s; before, only fixes whose own check failed are dropped",
              _TAKE_OVER, action=OutputAction.HOLD, clear_s=3.0,
              repeat_s=10.0),
    AlertSpec(A.FIXES_NOT_CHECKED, ERROR, "fix checks failed", "fix dropped: its checks failed", {},
              "a fix's correction by the map's offset fails by a program fault (other checks: "
              "`monitor_failed`)", "no such fault for 3 s",
              "this fix is not sent, others are",
              "if `no_fresh_fix` follows, take over; after landing read the log",
              clear_s=3.0, repeat_s=10.0),
    AlertSpec(A.COMPONENT_STALLED, WARNING, "component stalled",
              "{component} stalled {seconds:.0f} s", {"seconds": "s", "component": "name"},
              "the thread `health` has not run for 4 s", "it runs for 3 s",
              "health.json, the heartbeat's state and texts such as `localization lost` are out of "
              "date; fixes are still sent; with `--supervised` the process is replaced "
              "(`companion_restarts`)", _IF_LASTS,
              clear_s=3.0, repeat_s=10.0),
)  # fmt: skip
SOURCES: tuple[AlertSpec, ...] = (
    AlertSpec(A.GNSS_REFUSED, WARNING, "GNSS refused", "GNSS refused: {size:.1f} {why}",
              {"size": "m or m/s", "why": GnssDisagreement},
              "the EKF uses vision, and GNSS has a 3D fix, but for 2 s it differs from vision "
              "(*off vision*) or from the IMU's motion (*off IMU*), scatters (*noise*), or states "
              "over 5 m accuracy (*claimed*); N: by how much",
              "GNSS agrees for 5 s; without a text: no 3D fix, or the EKF uses GNSS",
              "GNSS is jammed, spoofed or not settled, or the map has an offset; the program does "
              "not select GNSS, and the EKF stays on vision",
              "select GNSS only if landmarks confirm it",
              cleared_text="GNSS agrees with vision", raise_s=2.0, clear_s=5.0, repeat_s=10.0),
)  # fmt: skip
