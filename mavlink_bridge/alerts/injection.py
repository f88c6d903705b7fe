"""Alerts about the positions that are sent, and about the EKF's reaction."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import AlertSpec, Kind, Severity, condition, event
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import CommandAnswer, InjectionOrder, RcChannel

WARNING, NOTICE, INFO = Severity.WARNING, Severity.NOTICE, Severity.INFO
_NOT_SENT, _NOT_READY = "not sent: ", "not ready: "
_BY_HAND = "without GNSS fly in STABILIZE or ALT_HOLD"
_WAIT = "wait; " + _BY_HAND
_PARAMETERS = "check the parameters with `companion doctor`"
_LANDMARKS = "compare the position with landmarks"
_UNVERIFIED = "fixes are sent although map and calibration are not verified against GNSS"
_MAP = "do not fly on vision: check map, calibration and datum"
_NONE = "nothing"
_SENT = "fixes are sent"
_NOT_VERIFIED = "vision is not verified against GNSS; nothing is sent"
_BY: dict[str, Kind] = {"by": (InjectionOrder, RcChannel)}

INJECTION: tuple[AlertSpec, ...] = (
    event(A.INJECTING, INFO, "injecting", {},
          "mode inject: the first fix is sent; again 1.5 s after a *not sent* alert ended, or up "
          "to 60 s after it if it recurs", "the autopilot receives fixes", _NONE),
    condition(A.NO_FIX_YET, WARNING, "no fix yet", {}, "no fix since the start; never sent as text",
              "the first fix", "vision has no position, so nothing is sent", _WAIT,
              lead=_NOT_SENT),
    condition(A.NO_FRESH_FIX, WARNING, "no fresh fix", {},
              "nothing was sent for 1 s, because the newest fix that passed the checks is older "
              "than delay_ms + 0.5 s, or no fix passed for two usual intervals", "a fix passes",
              "the EKF receives no position; vision gives no fix, or the integrity monitor holds "
              "the fixes",
              "if an *output held* alert is active, act on that alert; else " + _WAIT,
              lead=_NOT_SENT),
    condition(A.LINK_FULL, WARNING, "the link takes no more", {},
              "mode inject: the send buffer of the port is full for 1 s", "the port sends again",
              "the EKF receives no position", "check cable and baud rate; " + _BY_HAND,
              lead=_NOT_SENT),
    condition(A.COMMAND_NOT_TAKEN, WARNING, "command {answer}", {"answer": CommandAnswer},
              "mode inject, bridge.injection.message external_position_estimate: no fix is sent "
              "for 2 s, because "
              "the autopilot has not accepted the command; it is tested while the EKF uses GNSS",
              "the autopilot accepts the command",
              "the EKF receives no position; *not asked*: not tested yet; any other answer: this "
              "firmware cannot use the command",
              "*not asked*: wait for GNSS; else set another bridge.injection.message; "
              + _BY_HAND, lead=_NOT_SENT),
    condition(A.EKF_NO_ORIGIN, WARNING, "the EKF has no origin", {},
              "a fix is due, the message is relative to the EKF origin, and no GPS_GLOBAL_ORIGIN "
              "was received", "GPS_GLOBAL_ORIGIN is received", "the EKF receives no position",
              "set the EKF origin from the ground station, or set bridge.origin", lead=_NOT_SENT),
    condition(A.EKF_ORIGIN_FAR, WARNING, "EKF origin {kilometres:.0f} km away",
              {"kilometres": "km"}, "a fix is due, and the origin is over 100 km from it",
              "it is within 100 km",
              "the origin or the map is wrong; the EKF receives no position",
              "check the map and the EKF's origin", lead=_NOT_SENT),
    condition(A.NO_ATTITUDE, WARNING, "no attitude for ODOMETRY", {},
              "bridge.injection.message odometry: no ATTITUDE for the time of a fix", "ATTITUDE "
              "is received",
              "ODOMETRY needs the attitude; the EKF receives no position",
              "check the rate of ATTITUDE; " + _BY_HAND, lead=_NOT_SENT),
    condition(A.SIGMA_OVER_LIMIT, WARNING, "sigma {metres:.1f} m over limit", {"metres": "m"},
              "the horizontal sigma of a fix is above 10 m", "it is 10 m or less",
              "the position is too uncertain; the EKF receives none, and of odometry's only the "
              "change", _WAIT, lead=_NOT_SENT),
    condition(A.YAW_MISMATCH, WARNING, "vision yaw {degrees:+.0f} deg off autopilot",
              {"degrees": "deg"},
              "three of five fixes fail the yaw guard: vision's yaw is 3.5 deg off the "
              "autopilot's, or off the gyros since earlier fixes",
              "five fixes in a row are within 70 % of the limit",
              "compass, camera mounting or map is rotated; the EKF receives no position",
              "check compass and camera mounting; " + _BY_HAND, lead=_NOT_SENT),
    condition(A.INHIBITED, WARNING, "{alert}", {"alert": A},
              "mode inject: injection has not started, fixes come, and for 10 s an alert that "
              "inhibits is active", "no such alert is active",
              "injection does not start; the text names the alert; the pilot (mode rc) and "
              "`force` override it",
              "act on that alert; " + _BY_HAND, lead=_NOT_SENT),
    condition(A.SHADOW_NOT_COMPARED, WARNING, "no fix compared with GNSS", {},
              "no fix of the last two minutes could be compared with GNSS", "a fix is compared",
              _NOT_VERIFIED, "wait; check that GNSS has a 3D fix", lead=_NOT_READY),
    condition(A.SHADOW_FEW_FIXES, WARNING, "{fixes:.0f} of {needed:.0f} fixes",
              {"fixes": "", "needed": ""},
              "fewer than 50 fixes of the last two minutes were compared with GNSS",
              "50 fixes are compared", _NOT_VERIFIED, "wait", lead=_NOT_READY),
    condition(A.SHADOW_RATE, WARNING, "{hertz:.1f} Hz, needs {needed:.0f}",
              {"hertz": "Hz", "needed": "Hz"},
              "50 fixes or more were compared in two minutes, at less than 4 Hz",
              "the rate is 4 Hz or more", "too few fixes for the EKF; nothing is sent",
              "check the computer's load", lead=_NOT_READY),
    condition(A.SHADOW_MEDIAN, WARNING, "median error {metres:.1f} m", {"metres": "m"},
              "the median horizontal difference of fixes and GNSS in two minutes is above 3 m",
              "it is 3 m or less", "the map may have an offset; nothing is sent", _MAP,
              lead=_NOT_READY),
    condition(A.SHADOW_P95, WARNING, "p95 error {metres:.1f} m", {"metres": "m"},
              "the 95th percentile of the horizontal differences of fixes and GNSS in two "
              "minutes is above 6 m",
              "it is 6 m or less", "some fixes are wrong; nothing is sent", _MAP,
              lead=_NOT_READY),
    condition(A.SHADOW_COVARIANCE, WARNING, "error over claimed covariance", {},
              "half of the differences in two minutes exceed three times the ones that the "
              "covariance predicts", "they are smaller",
              "fixes are less accurate than they state; nothing is sent", _MAP, lead=_NOT_READY),
    condition(A.SHADOW_HEIGHT, WARNING, "height {metres:+.0f} m; check geoid", {"metres": "m"},
              "the median height difference in two minutes is above 10 m", "it is 10 m or less",
              "geoid, vertical datum or barometer is wrong; nothing is sent", _MAP,
              lead=_NOT_READY),
    condition(A.SHADOW_YAW, WARNING, "yaw differs by {degrees:+.1f} deg", {"degrees": "deg"},
              "the yaw guard blocks (`yaw_mismatch`)",
              "the yaw guard no longer blocks, and 50 fixes of the last two minutes were compared; "
              "without GNSS it does not end",
              "compass or camera mounting is wrong; nothing is sent; while the guard blocks, only "
              "health.json shows this alert; it becomes a text if the guard releases and the "
              "shadow check stays failed",
              "check compass and camera mounting", lead=_NOT_READY),
    condition(A.SHADOW_RESTORED, WARNING, "failed before the restart", {},
              "at the start: the process before this one crashed or was killed after the shadow "
              "check had failed, at most 10 min ago", "the shadow check passes",
              "the failure is still valid; nothing is sent", _MAP, lead=_NOT_READY),
    event(A.INJECTION_FORCED, WARNING, "injection forced, no shadow check", {},
          "modes inject and rc: injection starts because bridge.injection.force is set; the "
          "shadow check has no valid pass, or an alert inhibits", _UNVERIFIED,
          f"land if this flight is no test of `force`; else {_LANDMARKS}; remove `force` "
          "afterwards"),
    event(A.INJECTION_NOT_READY, WARNING, "injecting although not ready", {},
          "mode rc: the pilot enables injection, but the shadow check has no valid pass, or an "
          "alert inhibits", _UNVERIFIED, _LANDMARKS),
    event(A.INJECTION_UNCHECKED, WARNING, "injecting without shadow check", {},
          "mode inject: no 3D fix for 2 s, no failed shadow check, and no alert that inhibits",
          _UNVERIFIED, _LANDMARKS),
    event(A.INJECTION_ON, NOTICE, "injection on ({by})", _BY,
          "mode rc: the RC channel or a command enables injection",
          "fixes that pass the checks are sent", _NONE),
    event(A.INJECTION_OFF, NOTICE, "injection off, shadow ({by})", _BY,
          "mode rc: the start of the program, or the RC channel or a command disables injection",
          "nothing is sent; fixes are only compared with GNSS", _BY_HAND),
    event(A.INJECTION_RESTORED, NOTICE, "injection on (restored, {seconds:.0f} s old)",
          {"seconds": "s"},
          "mode rc: the process before this one crashed or was killed while injection was enabled "
          "by RC or command, at most 10 min ago",
          "injection stays enabled, and fixes that pass the checks are sent; seconds: age of the "
          "stored state",
          "use the RC channel or the command to disable it"),
    event(A.JUMP_REPEATED, NOTICE, "the EKF missed a jump: announced again", {},
          "after an announced jump the EKF's position stays elsewhere in three comparisons; at "
          "most five times", f"{_SENT}; the next one increments reset_counter again", _NONE),
    event(A.EKF_FOLLOWS, INFO, "the EKF follows", {},
          "3 s after the first fix is sent; again 3.5 s after an announced jump, or later, when "
          "the EKF is within 3 sigma + 1 m; at the end of `ekf_jump`; and 1.5 s after the end of "
          "one of the next six alerts, or up to 60 s after it if it recurs",
          "the EKF's position is that of the fixes", _NONE),
    condition(A.FIX_RATE_LOW, WARNING, "fix rate {hertz:.1f} Hz, needs {needed:.1f}",
              {"hertz": "Hz", "needed": "Hz"},
              "after at least 3 s of sent fixes: the rate over 3 s is below the shown minimum",
              "the rate is above it", f"{_SENT}; the EKF may stop using them",
              "check the computer's load"),
    condition(A.EKF_NOT_INITIALISED, WARNING, "the EKF is not initialised yet", {},
              "after at least 3 s of sent fixes: EKF_STATUS_REPORT has the flag EKF_UNINITIALIZED",
              "the flag is cleared", f"{_SENT}; the EKF uses none yet", "wait"),
    condition(A.EKF_NO_SOURCE, WARNING, "the EKF has no position source", {},
              "after at least 3 s of sent fixes: EKF_STATUS_REPORT has the flag EKF_CONST_POS_MODE",
              "the flag is cleared", f"{_SENT}; the EKF uses none",
              f"{_PARAMETERS}; {_BY_HAND}"),
    condition(A.EKF_NO_POSITION, WARNING, "the EKF reports no local position", {},
              "after at least 3 s of sent fixes: no LOCAL_POSITION_NED is received for them",
              "LOCAL_POSITION_NED is received",
              f"{_SENT}; whether the EKF uses them is unknown", _PARAMETERS),
    condition(A.EKF_OFF_FIXES, WARNING, "the EKF is {metres:.1f} m from what is sent",
              {"metres": "m"},
              "after at least 3 s of sent fixes: the median of the EKF's differences from them "
              "over 3 s "
              "is above 2 m + 5 sigma", "the difference is smaller",
              f"{_SENT}; source set, EKF origin or yaw is wrong",
              f"in flight: {_LANDMARKS}; select the GNSS source set if GNSS is good; {_BY_HAND}; "
              f"after landing {_PARAMETERS}"),
    condition(A.EKF_REJECTS_FIXES, WARNING, "the EKF rejects positions", {},
              "after at least 3 s of sent fixes: the horizontal test ratio in EKF_STATUS_REPORT is "
              "above 1", "it is 1 or less", f"{_SENT}; the EKF does not use them",
              "act as for `ekf_rejects_vision`; later check VISO_POS_M_NSE and the delay"),
    condition(A.FIXES_LATE, WARNING, "fixes {age_ms:.0f} ms old, delay_ms {limit_ms:.0f}",
              {"age_ms": "ms", "limit_ms": "ms"},
              "each of the last 50 fixes (PX4, unknown firmware: their median) arrived over 10 ms "
              "older than delay_ms",
              "that age is below 90 % of delay_ms + 10 ms for 15 s",
              f"{_SENT}; the EKF assumes that they are newer than they are",
              "raise delay_ms and the autopilot's delay parameter"),
    condition(A.FIXES_OVER_LIMIT, WARNING, "fixes {age_ms:.0f} ms old, limit {limit_ms:.0f}",
              {"age_ms": "ms", "limit_ms": "ms"},
              "the median age of the last 50 fixes is above what the firmware can use (ArduPilot "
              "250 ms, PX4 300 ms)",
              "it is below 90 % of the limit for 15 s",
              "fixes are extrapolated by at most 0.5 s and sent; what is older is not sent",
              "use a faster computer or a smaller localizer.width"),
    event(A.FIXES_IN_TIME, INFO, "fixes are in time again", {},
          "no late fix for 15 s; up to 60 s if it recurs", "the delay matches delay_ms again",
          _NONE),
    condition(A.YAW_UNCHECKED, WARNING, "yaw not checked: no attitude or gimbal", {},
              "20 fixes in a row had no attitude or no gimbal angles for their time",
              "a fix has both",
              "a wrong yaw of vision would not be detected; fixes are sent, but not with "
              "bridge.injection.message odometry if ATTITUDE is missing (`no_attitude`), and not "
              "if the yaw guard already blocks (`yaw_mismatch`)",
              "check the rates of ATTITUDE and the gimbal messages",
              "vision yaw is checked"),
    condition(A.CLOCK_NOT_SET, WARNING, "clock not set: GPS_INPUT has no time", {},
              "bridge.injection.message gps_input: the companion's clock is before 2023", "the "
              "clock is set",
              f"{_SENT}, without a time", "set the companion's clock, for example by NTP"),
    event(A.TLOG_INCOMPLETE, WARNING, "tlog is incomplete: {why}", {"why": "name"},
          "the .tlog cannot be written", "MAVLink messages are not recorded",
          "check the disk after landing"),
)  # fmt: skip
