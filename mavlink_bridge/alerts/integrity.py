"""Alerts of the integrity monitor, which checks every fix before it is injected."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import AlertSpec, Inhibits, OutputAction, Severity
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import CalibrationError, GnssDisagreement

WARNING, ERROR = Severity.WARNING, Severity.ERROR
_CALIBRATE = "run `companion calibrate flight` on this flight's record before the next flight"
_STABILIZE = "fly in STABILIZE or ALT_HOLD until it clears; land if it lasts and there is no GNSS"
_SENT = "fixes are sent"
_WIDER = "fixes are sent, with a larger covariance"
_LAND = "if it lasts and there is no GNSS, land in ALT_HOLD or STABILIZE"

INTEGRITY: tuple[AlertSpec, ...] = (
    AlertSpec(A.VIDEO_FROZEN, ERROR, "video frozen", "video frozen {seconds:.0f} s",
              {"seconds": "s"},
              "in flight: identical frames for 1.5 s; no image motion while the EKF's velocity "
              "moves the vehicle by 2 m; or no image motion for 3 s (longer high above the ground)",
              "the image moves for 2 s",
              "the camera or its link repeats an old frame, so the position does not change",
              _STABILIZE, action=OutputAction.EXCLUDE_AND_RESET, clear_s=2.0),
    AlertSpec(A.VIDEO_REPEATS, ERROR, "video repeats", "video repeats, {seconds:.0f} s old",
              {"seconds": "s"}, "in flight: the frames of 2 s equal frames at most 60 s before",
              "new frames for 5 s", "the video source plays a recording or a loop",
              _STABILIZE, action=OutputAction.EXCLUDE_AND_RESET, clear_s=5.0),
    AlertSpec(A.LOW_CONTRAST, WARNING, "low image contrast",
              "low image contrast {gray:.1f}: dark or haze", {"gray": "gray levels"},
              "in flight: the local contrast of the frames is below 2.0 gray levels of 255 for 2 s",
              "it is above for 5 s",
              f"{_SENT}; the image is dark or hazy, or the ground has no structure; vision will "
              "soon fail",
              "increase the camera's exposure; fly home, or select the GNSS source set if GNSS is "
              "good",
              raise_s=2.0, clear_s=5.0, repeat_s=60.0),
    AlertSpec(A.VISION_IMU_MISMATCH, ERROR, "vision/IMU mismatch",
              "vision/IMU mismatch {metres:.0f} m", {"metres": "m"},
              "the mean distance of the fixes from the positions that the IMU predicts is above "
              "1.5, 1.0 or 0.8 m (+ 4 sigma) over 1, 3 or 10 s, for 0.2 s",
              "for 5 s the distance is below half of that, and the position moves",
              "the vision position does not move as the vehicle does, so it is wrong", _STABILIZE,
              action=OutputAction.EXCLUDE_AND_RESET, raise_s=0.2, clear_s=5.0),
    AlertSpec(A.HEIGHT_MISMATCH, ERROR, "height mismatch", "height {metres:.0f} m off barometer",
              {"metres": "m"},
              "vision's height and the barometer's differ by 8 m, + 4 sigma and 16 % of the climb, "
              "more than before, for 2 s", "the difference is within the limit for 5 s",
              "vision's height is wrong, and its position is probably wrong too", _STABILIZE,
              action=OutputAction.EXCLUDE_AND_RESET, raise_s=2.0, clear_s=5.0),
    AlertSpec(A.POSITION_JUMP, ERROR, "position jump", "position jumped {metres:.0f} m",
              {"metres": "m"},
              "at once: a fix is 3 m (after an announced jump 10 m) farther from the last one "
              "than the vehicle can have flown",
              "the new position moves as the IMU for 5 s (up to 60 s, if vision's heading has "
              "turned unlike the gyros), or the old position is back",
              "vision has found another position; the old or the new one is wrong",
              "keep the mode for 5 s; if it lasts and there is no GNSS, fly in STABILIZE or "
              "ALT_HOLD",
              action=OutputAction.EXCLUDE_AND_RESET),
    AlertSpec(A.POSITION_STEP, WARNING, "position step",
              "position step {metres:.0f} m, unexplained", {"metres": "m"},
              "the position steps by more than 1 m and 4 sigma, but less than a jump",
              "the position steps back; the calibration watch confirms the timestamps (a step "
              "along the course); a search confirms the position (a step across); or disarmed",
              f"{_WIDER}; the position may be wrong by this distance (3 m at most), which was "
              "added to the protection level",
              "increase the distance to obstacles by this value", repeat_s=60.0),
    AlertSpec(A.TILT_MISMATCH, WARNING, "tilt mismatch", "tilt {degrees:.0f} deg off autopilot",
              {"degrees": "deg"},
              "vision's roll and pitch differ from gimbal and autopilot by more than 3 sigma (2.7 "
              "deg or more) for 1 s",
              "the difference is below 2 sigma for 3 s",
              f"{_WIDER}; low over ground with little structure, a tilt and a shift of the camera "
              "have the same effect on the image; a tilt error shifts the position by tilt times "
              "height; this shift (3 m at most) was added to the protection level",
              "climb, or fly over buildings and roads", raise_s=1.0, clear_s=3.0,
              repeat_s=60.0),
    AlertSpec(A.GNSS_VISION_MISMATCH, WARNING, "GNSS/vision mismatch",
              "GNSS/vision mismatch {metres:.0f} m", {"metres": "m"},
              "their horizontal distance exceeds vision's protection level plus 4 times the "
              "receiver's stated accuracy (1 to 3 m) plus 0.2 s times the speed, for 2 s; not with "
              "gps_input",
              "the distance is within the limit for 5 s; without GNSS or without fixes the alert "
              "stays",
              f"{_SENT}; GNSS or vision is wrong; which one is not known",
              "compare with landmarks; select the source set that is right", raise_s=2.0,
              clear_s=5.0, repeat_s=10.0),
    AlertSpec(A.EKF_REJECTS_VISION, WARNING, "EKF rejects vision",
              "EKF rejects vision ({ratio:.1f})", {"ratio": ""},
              "a fix came in the last second, and the horizontal test ratio in EKF_STATUS_REPORT "
              "is above 1, for 2 s",
              "the ratio is 1 or less, or no fix came, for 3 s",
              f"{_SENT}; the EKF does not use them, and its position drifts; while nothing is "
              "injected, the ratio is that of GNSS",
              "fly in STABILIZE or ALT_HOLD, or select GNSS if it is good", raise_s=2.0,
              clear_s=3.0, repeat_s=10.0),
    AlertSpec(A.EKF_JUMP, WARNING, "EKF jump", "EKF jumped {metres:.0f} m, unconfirmed",
              {"metres": "m"},
              "armed: LOCAL_POSITION_NED steps by 3 m more than the velocity explains, at once",
              "vision moves as the IMU, and output is not held, for 10 s; or disarmed",
              f"{_SENT}; the EKF was reset to a position that is not confirmed yet; `ekf_follows` "
              "is not reported",
              "compare the position with landmarks until it clears", inhibits=Inhibits.EKF_OK),
    AlertSpec(A.VIDEO_TIMESTAMPS, ERROR, "video timestamps", "video timestamps not monotonic", {},
              "five frames in a row have timestamps that do not increase, for 0.5 s",
              "frames are newer than all before for 3 s",
              "the video's timestamps are wrong, so the times of the positions are wrong",
              "restart the video source if it lasts", action=OutputAction.HOLD, raise_s=0.5,
              clear_s=3.0),
    AlertSpec(A.HPL_OVER_LIMIT, ERROR, "HPL over limit", "HPL {metres:.0f} m over limit",
              {"metres": "m"},
              "the horizontal protection level (HPL) is above `bridge.injection.alert_limit_m` "
              "for 1 s", "it is below the limit for 3 s",
              "the possible position error is larger than the limit; no position is sent, but "
              "while odometry bridges, the velocity is",
              f"fly higher, or over buildings and roads; {_LAND}",
              action=OutputAction.HOLD, raise_s=1.0, clear_s=3.0),
    AlertSpec(A.FOCAL_LENGTH, WARNING, "focal length", "focal length {percent:.1f} % {direction}",
              {"percent": "%", "direction": CalibrationError},
              "the estimated focal length differs from the calibration by 2.5 % and 4 sigma for 2 "
              "s", "it is within the limit for 10 s",
              f"if injection has started, {_WIDER}; positions are wrong by about this share of "
              "the height above ground",
              _CALIBRATE,
              inhibits=Inhibits.INJECTION, raise_s=2.0, clear_s=10.0, repeat_s=60.0),
    AlertSpec(A.BORESIGHT, WARNING, "boresight", "camera {degrees:.0f} deg off in {axis}",
              {"degrees": "deg", "axis": CalibrationError},
              "the attitude from vision differs from that of gimbal and autopilot by 3 deg and 4 "
              "sigma for 3 s", "it is within the limit for 10 s",
              f"if injection has started, {_SENT}; the mounting angles in the deployment file, "
              "the gimbal or the compass are wrong",
              _CALIBRATE,
              inhibits=Inhibits.INJECTION, raise_s=3.0, clear_s=10.0, repeat_s=60.0),
    AlertSpec(A.TIME_OFFSET, WARNING, "time offset",
              "video timestamps {milliseconds:.0f} ms {direction}",
              {"milliseconds": "ms", "direction": CalibrationError},
              "vision's motion is late or early by 80 ms and 4 sigma for 1 s",
              "it is within the limit for 10 s",
              f"if injection has started, {_WIDER}; positions are behind or ahead of the vehicle "
              "by speed times this value",
              "fly slowly; set `camera.settings.time_offset_ms` before the next flight",
              inhibits=Inhibits.INJECTION, raise_s=1.0, clear_s=10.0, repeat_s=60.0),
)  # fmt: skip
MONITOR: tuple[AlertSpec, ...] = (
    AlertSpec(A.MONITOR_FAILED, ERROR, "integrity monitor failed", "integrity monitor failed", {},
              "a check raises an exception, or the monitor's thread does not run for 2 s",
              "all checks run again for 3 s",
              "nothing is sent while the thread does not run, or after ten failed runs (1 s); a "
              "shorter failure stops at most the fix that was being checked",
              _LAND, action=OutputAction.HOLD, clear_s=3.0,
              repeat_s=10.0),
    AlertSpec(A.FIXES_NOT_CHECKED, ERROR, "fix checks failed", "fix checks failed", {},
              "the checks of a fix raise an exception", "all fixes are checked again for 3 s",
              "this fix is not sent; each later fix is sent if its own checks run, although the "
              "text says *output held* until the end of the alert", _LAND,
              action=OutputAction.HOLD, clear_s=3.0, repeat_s=10.0),
    AlertSpec(A.COMPONENT_STALLED, WARNING, "component stalled",
              "{component} stalled {seconds:.0f} s", {"seconds": "s", "component": "name"},
              "the thread `health`, which assesses the localization every second, has not run for "
              "4 s", "it runs again for 3 s",
              "fixes are still checked and sent; health.json, the heartbeat's status and alerts "
              "such as `lost` are out of date", _LAND,
              clear_s=3.0, repeat_s=10.0),
)  # fmt: skip
SOURCES: tuple[AlertSpec, ...] = (
    AlertSpec(A.GNSS_REFUSED, WARNING, "GNSS refused", "GNSS refused: {size:.1f} {why}",
              {"size": "m or m/s", "why": GnssDisagreement},
              "the EKF uses vision and GNSS is back, but its position or velocity differs from "
              "vision or IMU, it scatters, or it states an accuracy above 5 m, for 2 s",
              "it agrees for 5 s",
              "fixes are sent, and the EKF stays on vision; the receiver is jammed, "
              "spoofed or not settled, or the map has an offset",
              "stay on vision; select GNSS only if landmarks confirm it",
              cleared_text="GNSS agrees with vision", raise_s=2.0, clear_s=5.0, repeat_s=10.0),
)  # fmt: skip
