"""Alerts of the integrity monitor, which checks every fix before it is injected."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import AlertSpec, Inhibits, OutputAction, Severity
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import CalibrationError, GnssDisagreement

WARNING, ERROR = Severity.WARNING, Severity.ERROR
_WITHIN = "the difference + 2 sigma is below the limit for 10 s"
_CALIBRATE = "before the next flight run `companion calibrate flight` on this flight's record"
_TAKE_OVER = "take over; if it lasts without good GNSS, land"
_SENT = "fixes continue"
_WIDER = "fixes continue, with a larger covariance"
_LAND = "if it lasts without good GNSS, take over and land"
_OR_GNSS = "select the GNSS source set if GNSS is good"

INTEGRITY: tuple[AlertSpec, ...] = (
    AlertSpec(A.VIDEO_FROZEN, ERROR, "video frozen", "video frozen {seconds:.0f} s",
              {"seconds": "s"},
              "in flight: identical frames for 1.5 s; or no image motion while the EKF's velocity "
              "moves the vehicle by 2 m; or no image motion for 3 s (2 s + 0.027 s per metre of "
              "ground across the image, if that is longer)",
              "the image moves for 2 s",
              "camera or link repeat an old frame, so the position from vision stands still",
              _TAKE_OVER, action=OutputAction.EXCLUDE_AND_RESET, clear_s=2.0),
    AlertSpec(A.VIDEO_REPEATS, ERROR, "video repeats", "video repeats, {seconds:.0f} s old",
              {"seconds": "s"}, "in flight: the frames of 2 s equal frames of the last 60 s",
              "frames are new for 5 s",
              "the video source plays a recording or a loop; N: age of the shown frames",
              _TAKE_OVER, action=OutputAction.EXCLUDE_AND_RESET, clear_s=5.0),
    AlertSpec(A.LOW_CONTRAST, WARNING, "low image contrast",
              "low image contrast {gray:.1f}: dark or haze", {"gray": "gray levels"},
              "in flight: the local contrast of the frames is below 2.0 gray levels of 255 for 2 s",
              "it is above for 5 s",
              f"{_SENT}; the image is dark or hazy, or the ground has no structure; vision will "
              "fail soon",
              f"increase the camera's exposure; fly home, or {_OR_GNSS}",
              raise_s=2.0, clear_s=5.0, repeat_s=60.0),
    AlertSpec(A.VISION_IMU_MISMATCH, ERROR, "vision/IMU mismatch",
              "vision/IMU mismatch {metres:.0f} m", {"metres": "m"},
              "the mean distance between fixes and the positions that the IMU predicts exceeds a "
              "limit for 0.2 s: 1.5 m over 1 s, 1.0 m over 3 s or 0.8 m over 10 s, + 4 sigma of "
              "this mean + 1.5 sigma of a fix",
              "the distance is below half of the limit, and the position moves, for 5 s",
              "the position from vision does not move as the vehicle does: it is wrong", _TAKE_OVER,
              action=OutputAction.EXCLUDE_AND_RESET, raise_s=0.2, clear_s=5.0),
    AlertSpec(A.HEIGHT_MISMATCH, ERROR, "height mismatch", "height {metres:.0f} m off barometer",
              {"metres": "m"},
              "the difference between vision's height and the barometer's has changed by more than "
              "8 m + 4 sigma + 16 % of the climb, for 2 s", "it is within the limit for 5 s",
              "vision's height is wrong, and its horizontal position probably too", _TAKE_OVER,
              action=OutputAction.EXCLUDE_AND_RESET, raise_s=2.0, clear_s=5.0),
    AlertSpec(A.POSITION_JUMP, ERROR, "position jump", "position jumped {metres:.0f} m",
              {"metres": "m"},
              "at once: a fix is 3 m farther from the last one than flight and 4 sigma explain; "
              "10 m if the localizer announced the jump (it found the position again)",
              "the new position moves as the IMU for 5 s (up to 60 s if vision's heading turned "
              "and the gyros did not), or the old position is back",
              "the old or the new position is wrong",
              "wait 5 s; if it lasts, take over",
              action=OutputAction.EXCLUDE_AND_RESET),
    AlertSpec(A.POSITION_STEP, WARNING, "position step",
              "position step {metres:.0f} m, unexplained", {"metres": "m"},
              "the mean of five fixes is off that of the five before by more than 1 m, and by "
              "more than motion and 4 sigma explain; but by less than a jump (3 m)",
              "the position steps back; or the vehicle is disarmed; or, for a step along the "
              "course, the measured time offset is within 80 ms (`time_offset`) or half of the "
              "delay that would explain the step; or, for a step "
              "across, the position is lost and found again",
              f"{_WIDER}; the position may be wrong by N (sum of the steps, at most 3 m; in a "
              "hover each counts as across), which the protection level now includes",
              "increase the distance to obstacles by N", repeat_s=60.0),
    AlertSpec(A.TILT_MISMATCH, WARNING, "tilt mismatch", "tilt {degrees:.0f} deg off autopilot",
              {"degrees": "deg"},
              "vision's roll and pitch differ from those of gimbal and autopilot by more than 3 "
              "sigma (2.7 deg or more) for 1 s",
              "the difference is below 2 sigma for 3 s",
              f"{_WIDER}; the position may be wrong by tilt times height, at most 3 m, which the "
              "protection level now includes; cause: low over ground with little structure, tilt "
              "and shift look alike",
              "climb, or fly over buildings and roads", raise_s=1.0, clear_s=3.0,
              repeat_s=60.0),
    AlertSpec(A.GNSS_VISION_MISMATCH, WARNING, "GNSS/vision mismatch",
              "GNSS/vision mismatch {metres:.0f} m", {"metres": "m"},
              "their horizontal distance exceeds vision's protection level + 4 times the "
              "receiver's stated accuracy (1 to 3 m) + 0.2 s times the speed, for 2 s; not with "
              "message gps_input",
              "the distance is within the limit for 5 s; not while GNSS or fixes are missing",
              f"{_SENT}; GNSS or vision is wrong, and it is not known which",
              "compare with landmarks; select the source set that is right", raise_s=2.0,
              clear_s=5.0, repeat_s=10.0),
    AlertSpec(A.EKF_REJECTS_VISION, WARNING, "EKF rejects vision",
              "EKF rejects vision ({ratio:.1f})", {"ratio": ""},
              "the horizontal test ratio in EKF_STATUS_REPORT is above 1 for 2 s, while fixes are "
              "made", "the ratio is 1 or less, or no fix is made, for 3 s",
              f"{_SENT}, but the EKF does not use them, and its position drifts; if injection is "
              "off, the EKF rejects GNSS; N: the ratio", "take over", raise_s=2.0,
              clear_s=3.0, repeat_s=10.0),
    AlertSpec(A.EKF_JUMP, WARNING, "EKF jump", "EKF jumped {metres:.0f} m, unconfirmed",
              {"metres": "m"},
              "armed: LOCAL_POSITION_NED steps by 3 m more than the velocity explains",
              "vision moves as the IMU, and output is not held, for 10 s; or disarmed",
              f"{_SENT}; the EKF was reset to a position that is not confirmed yet; until then "
              "`ekf_follows` is not reported",
              "compare the position with landmarks until it ends", inhibits=Inhibits.EKF_OK),
    AlertSpec(A.VIDEO_TIMESTAMPS, ERROR, "video timestamps", "video timestamps not monotonic", {},
              "the timestamps of five frames in a row do not increase, for 0.5 s",
              "frames are newer than all before for 3 s",
              "the video's timestamps are wrong, and with them the times of the positions",
              "take over; if it lasts, restart the video source", action=OutputAction.HOLD,
              raise_s=0.5, clear_s=3.0),
    AlertSpec(A.HPL_OVER_LIMIT, ERROR, "HPL over limit", "HPL {metres:.0f} m over limit",
              {"metres": "m"},
              "the horizontal protection level (HPL) is above "
              "`bridge.injection.alert_limit_m` (default 10 m) for 1 s",
              "it is below the limit for 3 s",
              "the position may be wrong by N; no position is sent, but during `bridging` "
              "ArduPilot receives the velocity",
              f"fly higher, or over buildings and roads; {_LAND}",
              action=OutputAction.HOLD, raise_s=1.0, clear_s=3.0),
    AlertSpec(A.FOCAL_LENGTH, WARNING, "focal length", "focal length {percent:.1f} % {direction}",
              {"percent": "%", "direction": CalibrationError},
              "the estimated focal length differs from the calibration by more than 2.5 %, and by "
              "more than 4 sigma, for 2 s", _WITHIN,
              f"{_WIDER}; positions are wrong by about N % of the height above ground",
              _CALIBRATE,
              inhibits=Inhibits.INJECTION, raise_s=2.0, clear_s=10.0, repeat_s=60.0),
    AlertSpec(A.BORESIGHT, WARNING, "boresight", "camera {degrees:.0f} deg off in {axis}",
              {"degrees": "deg", "axis": CalibrationError},
              "the attitude from vision differs from that of gimbal and autopilot by more than 3 "
              "deg, and by more than 4 sigma, for 3 s", _WITHIN,
              f"{_SENT}; AXIS: roll, pitch or yaw; the mounting angles in the deployment file, "
              "the gimbal or the compass are wrong",
              _CALIBRATE,
              inhibits=Inhibits.INJECTION, raise_s=3.0, clear_s=10.0, repeat_s=60.0),
    AlertSpec(A.TIME_OFFSET, WARNING, "time offset",
              "video timestamps {milliseconds:.0f} ms {direction}",
              {"milliseconds": "ms", "direction": CalibrationError},
              "vision's motion is late or early by more than 80 ms, and by more than 4 sigma, for "
              "1 s",
              _WITHIN,
              f"{_WIDER}; positions are behind (late) or ahead of (early) the vehicle by speed "
              "times N",
              "fly slowly; before the next flight set `camera.settings.time_offset_ms`",
              inhibits=Inhibits.INJECTION, raise_s=1.0, clear_s=10.0, repeat_s=60.0),
)  # fmt: skip
MONITOR: tuple[AlertSpec, ...] = (
    AlertSpec(A.MONITOR_FAILED, ERROR, "integrity monitor failed", "integrity monitor failed", {},
              "a check fails by a fault in the program, or the monitor's thread does not run for "
              "2 s",
              "all checks run again for 3 s",
              "no position is sent while the thread does not run, or after ten failed runs in a "
              "row (1 s); a shorter failure drops at most one fix",
              _TAKE_OVER, action=OutputAction.HOLD, clear_s=3.0,
              repeat_s=10.0),
    AlertSpec(A.FIXES_NOT_CHECKED, ERROR, "fix checks failed", "fix dropped: its checks failed", {},
              "the comparison of a fix with the map's offset fails by a fault in the program (a "
              "fault of the other checks raises `monitor_failed`)", "no such fault for 3 s",
              "the fix is dropped; other fixes are checked and sent as usual",
              "if `no_fresh_fix` follows, take over; after landing read the log",
              clear_s=3.0, repeat_s=10.0),
    AlertSpec(A.COMPONENT_STALLED, WARNING, "component stalled",
              "{component} stalled {seconds:.0f} s", {"seconds": "s", "component": "name"},
              "the thread `health`, which assesses the localization every second, has not run for "
              "4 s", "it runs again for 3 s",
              f"{_SENT}, and are checked; health.json, the heartbeat's status and alerts such as "
              "`lost` are out of date", _LAND,
              clear_s=3.0, repeat_s=10.0),
)  # fmt: skip
SOURCES: tuple[AlertSpec, ...] = (
    AlertSpec(A.GNSS_REFUSED, WARNING, "GNSS refused", "GNSS refused: {size:.1f} {why}",
              {"size": "m or m/s", "why": GnssDisagreement},
              "the EKF uses vision, GNSS has a 3D fix, and for 2 s its position or velocity "
              "differs from vision or IMU, scatters, or has a stated accuracy above 5 m",
              "GNSS has no 3D fix, or the EKF uses GNSS, or GNSS agrees for 5 s",
              f"{_SENT}, and the EKF stays on vision; the receiver is jammed, spoofed or not "
              "settled, or the map has an offset",
              "stay on vision; select GNSS only if landmarks confirm it",
              cleared_text="GNSS agrees with vision", raise_s=2.0, clear_s=5.0, repeat_s=10.0),
)  # fmt: skip
