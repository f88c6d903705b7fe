"""Alerts about the positions that are sent, and about the EKF's reaction."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import AlertSpec, Kind, Severity, condition, event
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import CommandAnswer, InjectionOrder, RcChannel

WARNING, NOTICE, INFO = Severity.WARNING, Severity.NOTICE, Severity.INFO
_NOT_SENT, _NOT_READY = "not sent: ", "not ready: "
_TAKE_OVER = "take over"
_PARAMETERS = "check the parameters with `companion doctor`"
_LANDMARKS = "compare the position with landmarks"
_UNVERIFIED = "fixes are sent, although map and calibration are not verified against GNSS"
_MAP = "do not fly on vision: check map, calibration and datum"
_NONE = "nothing"
_SENT = "fixes continue"
_NOT_VERIFIED = "vision is not verified against GNSS"
_BY: dict[str, Kind] = {"by": (InjectionOrder, RcChannel)}

INJECTION: tuple[AlertSpec, ...] = (
    event(A.INJECTING, INFO, "injecting", {},
          "mode inject: the first fix is sent; also 1.5 s after the end of a *not sent* alert (up "
          "to 60 s if it recurs)", "the autopilot receives fixes", _NONE),
    condition(A.NO_FIX_YET, WARNING, "no fix yet", {},
              "no fix since the start; never sent as a text",
              "the first fix", "vision has not found a position", _TAKE_OVER,
              lead=_NOT_SENT),
    condition(A.NO_FRESH_FIX, WARNING, "no fresh fix", {},
              "nothing was sent for 1 s, because the newest fix that passed the checks is older "
              "than `bridge.injection.delay_ms` + 0.5 s, or because no fix has passed for twice "
              "the usual interval between fixes",
              "a fix passes the checks",
              "vision makes no fix, an *output held* alert is active, or fixes are dropped "
              "(`fixes_not_checked`)",
              "if an *output held* alert is active, act on it; otherwise take over",
              lead=_NOT_SENT),
    condition(A.LINK_FULL, WARNING, "the link takes no more", {},
              "mode inject: the send buffer of the port is full for 1 s", "the port sends again",
              "the connection is too slow or broken", f"{_TAKE_OVER}; check cable and baud rate",
              lead=_NOT_SENT),
    condition(A.COMMAND_NOT_TAKEN, WARNING, "command {answer}", {"answer": CommandAnswer},
              "mode inject with message external_position_estimate: the autopilot has not accepted "
              "the command for 2 s; the first one is sent as a test while the EKF uses GNSS",
              "the autopilot accepts the command",
              "*not asked*: not tested yet, because GNSS is missing; any other answer: this "
              "firmware does not use the command",
              f"{_TAKE_OVER}; *not asked*: wait for GNSS; else set another message",
              lead=_NOT_SENT),
    condition(A.EKF_NO_ORIGIN, WARNING, "the EKF has no origin", {},
              "a fix is due in a message relative to the EKF origin, and GPS_GLOBAL_ORIGIN was not "
              "received", "GPS_GLOBAL_ORIGIN is received",
              "a position relative to the origin cannot be computed",
              f"{_TAKE_OVER}; set the EKF origin from the ground station, or set `bridge.origin`",
              lead=_NOT_SENT),
    condition(A.EKF_ORIGIN_FAR, WARNING, "EKF origin {kilometres:.0f} km away",
              {"kilometres": "km"}, "a fix is due, and the EKF origin is over 100 km from it",
              "it is within 100 km",
              "the origin or the map is wrong",
              f"{_TAKE_OVER}; check the map and the EKF origin", lead=_NOT_SENT),
    condition(A.NO_ATTITUDE, WARNING, "no attitude for ODOMETRY", {},
              "with message odometry: no ATTITUDE for the time of a fix", "ATTITUDE "
              "is received",
              "ODOMETRY contains the attitude, so none can be sent",
              f"{_TAKE_OVER}; check the rate of ATTITUDE", lead=_NOT_SENT),
    condition(A.SIGMA_OVER_LIMIT, WARNING, "sigma {metres:.1f} m over limit", {"metres": "m"},
              "the horizontal sigma of a fix is above 10 m", "it is 10 m or less",
              "the position is too uncertain; the velocity of odometry is sent", _TAKE_OVER,
              lead=_NOT_SENT),
    condition(A.YAW_MISMATCH, WARNING, "vision yaw {degrees:+.0f} deg off autopilot",
              {"degrees": "deg"},
              "the yaw guard blocks: in three of five fixes vision's yaw is over 3.5 deg off the "
              "autopilot's (20 deg, if fixes passed in the last 60 s), or has turned over 3.5 deg "
              "differently from the gyros since earlier fixes",
              "five fixes in a row are within 70 % of the limit",
              "compass, camera mounting or map is rotated",
              f"{_TAKE_OVER}; check compass and camera mounting", lead=_NOT_SENT),
    condition(A.INHIBITED, WARNING, "{alert}", {"alert": A},
              "mode inject: fixes are made, but for 10 s an alert that inhibits (its name is the "
              "text) keeps injection from starting", "no alert inhibits",
              "injection does not start",
              f"act on the named alert; {_TAKE_OVER}", lead=_NOT_SENT),
    condition(A.SHADOW_NOT_COMPARED, WARNING, "no fix compared with GNSS", {},
              "no fix of the last two minutes was compared", "a fix is compared",
              _NOT_VERIFIED, "wait; check that GNSS has a 3D fix", lead=_NOT_READY),
    condition(A.SHADOW_FEW_FIXES, WARNING, "{fixes:.0f} of {needed:.0f} fixes",
              {"fixes": "", "needed": ""},
              "fewer than 50 fixes of the last two minutes were compared",
              "50 fixes are compared", _NOT_VERIFIED, "wait", lead=_NOT_READY),
    condition(A.SHADOW_RATE, WARNING, "{hertz:.1f} Hz, needs {needed:.0f}",
              {"hertz": "Hz", "needed": "Hz"},
              "50 or more fixes were compared, but fewer than 4 a second",
              "the rate is 4 Hz or more", "there are too few fixes for the EKF",
              "check the computer's load", lead=_NOT_READY),
    condition(A.SHADOW_MEDIAN, WARNING, "median error {metres:.1f} m", {"metres": "m"},
              "the median horizontal difference is above 3 m",
              "it is 3 m or less", "the map may have an offset", _MAP,
              lead=_NOT_READY),
    condition(A.SHADOW_P95, WARNING, "p95 error {metres:.1f} m", {"metres": "m"},
              "the 95th percentile of the horizontal differences is above 6 m",
              "it is 6 m or less", "some fixes are wrong", _MAP,
              lead=_NOT_READY),
    condition(A.SHADOW_COVARIANCE, WARNING, "error over claimed covariance", {},
              "half of the horizontal differences are more than three times as large as the "
              "covariance predicts", "they are smaller",
              "fixes are less accurate than their covariance states", _MAP, lead=_NOT_READY),
    condition(A.SHADOW_HEIGHT, WARNING, "height {metres:+.0f} m; check geoid", {"metres": "m"},
              "the median height difference is above 10 m", "it is 10 m or less",
              "geoid, vertical datum or barometer is wrong", _MAP,
              lead=_NOT_READY),
    condition(A.SHADOW_YAW, WARNING, "yaw differs by {degrees:+.1f} deg", {"degrees": "deg"},
              "the yaw guard blocks (`yaw_mismatch`)",
              "the yaw guard no longer blocks, and 50 fixes are compared",
              "compass or camera mounting is wrong; only in health.json while the guard blocks, "
              "because `yaw_mismatch` is the text then",
              "check compass and camera mounting", lead=_NOT_READY),
    condition(A.SHADOW_RESTORED, WARNING, "failed before the restart", {},
              "at the start: a process that crashed or was killed at most 10 min ago had failed "
              "the shadow check", "the shadow check passes",
              "that result is still valid", _MAP, lead=_NOT_READY),
    event(A.INJECTION_FORCED, WARNING, "injection forced, no shadow check", {},
          "injection starts because `bridge.injection.force` is set, without a valid pass of the "
          "shadow check or although an alert inhibits", _UNVERIFIED,
          f"land, unless this flight tests `force`; else {_LANDMARKS}; remove `force` "
          "afterwards"),
    event(A.INJECTION_NOT_READY, WARNING, "injecting although not ready", {},
          "mode rc: the pilot enables injection without a valid pass of the shadow check, or "
          "although an alert inhibits", _UNVERIFIED, _LANDMARKS),
    event(A.INJECTION_UNCHECKED, WARNING, "injecting without shadow check", {},
          "mode inject: GNSS has had no 3D fix for 2 s, the shadow check has not failed, and no "
          "alert inhibits", _UNVERIFIED, _LANDMARKS),
    event(A.INJECTION_ON, NOTICE, "injection on ({by})", _BY,
          "mode rc: the RC channel or a command enables injection",
          "fixes that pass the checks are sent", _NONE),
    event(A.INJECTION_OFF, NOTICE, "injection off, shadow ({by})", _BY,
          "mode rc: the program starts, or the RC channel or a command disables injection",
          "fixes are only compared with GNSS; none is sent", _TAKE_OVER),
    event(A.INJECTION_RESTORED, NOTICE, "injection on (restored, {seconds:.0f} s old)",
          {"seconds": "s"},
          "mode rc, at the start: a process that crashed or was killed at most 10 min ago had "
          "injection enabled",
          "fixes that pass the checks are sent; N: age of the stored state",
          "to disable it use the RC channel or the command"),
    event(A.JUMP_REPEATED, NOTICE, "the EKF missed a jump: announced again", {},
          "after an increment of `reset_counter` the EKF is still over 1 m + 3 sigma off in the "
          "median of three comparisons; "
          "at most five times", f"{_SENT}; the next one increments `reset_counter` again", _NONE),
    event(A.EKF_FOLLOWS, INFO, "the EKF follows", {},
          "3 s after the first fix is sent; also 3.5 s or more after an increment of "
          "`reset_counter`, when the EKF is within 3 sigma + 1 m; after the end of `ekf_jump`; and "
          "1.5 s after the end of an alert from `fix_rate_low` to `ekf_rejects_fixes` (up to 60 s "
          "if it recurs)",
          "the EKF's position is that of the fixes", _NONE),
    condition(A.FIX_RATE_LOW, WARNING, "fix rate {hertz:.1f} Hz, needs {needed:.1f}",
              {"hertz": "Hz", "needed": "Hz"},
              "the rate of sent fixes over 3 s is below 4 Hz (message gps_input: 4.65 Hz)",
              "the rate is above this minimum", f"{_SENT}; the EKF may stop using them",
              "compare with landmarks; on the ground check the computer's load"),
    condition(A.EKF_NOT_INITIALISED, WARNING, "the EKF is not initialised yet", {},
              "EKF_STATUS_REPORT has the flag EKF_UNINITIALIZED (ArduPilot)",
              "the flag is cleared", f"{_SENT}; the EKF uses none yet",
              _TAKE_OVER),
    condition(A.EKF_NO_SOURCE, WARNING, "the EKF has no position source", {},
              "EKF_STATUS_REPORT has the flag EKF_CONST_POS_MODE",
              "the flag is cleared", f"{_SENT}; the EKF uses none",
              f"{_TAKE_OVER}; on the ground {_PARAMETERS}"),
    condition(A.EKF_NO_POSITION, WARNING, "the EKF reports no local position", {},
              "for 3 s no LOCAL_POSITION_NED is received for the times of the sent fixes",
              "LOCAL_POSITION_NED is received",
              f"{_SENT}; whether the EKF uses them is unknown",
              f"{_TAKE_OVER}; on the ground {_PARAMETERS}"),
    condition(A.EKF_OFF_FIXES, WARNING, "the EKF is {metres:.1f} m from what is sent",
              {"metres": "m"},
              "the median distance of the EKF's position from the sent fixes over 3 s is above "
              "2 m + 5 sigma", "the distance is smaller",
              f"{_SENT}; source set, EKF origin or yaw is wrong",
              f"{_LANDMARKS}; {_TAKE_OVER}; on the ground {_PARAMETERS}"),
    condition(A.EKF_REJECTS_FIXES, WARNING, "the EKF rejects positions", {},
              "the horizontal test ratio in EKF_STATUS_REPORT is above 1", "it is 1 or less",
              f"{_SENT}; the EKF does not use them",
              f"{_TAKE_OVER}; after landing check VISO_POS_M_NSE and the delay"),
    condition(A.FIXES_LATE, WARNING, "fixes {age_ms:.0f} ms old, delay_ms {limit_ms:.0f}",
              {"age_ms": "ms", "limit_ms": "ms"},
              "each of the last 50 fixes (PX4, unknown firmware: their median) is over 10 ms older "
              "than `bridge.injection.delay_ms` when it is made",
              "that age is below 90 % of (delay_ms + 10 ms) for 15 s",
              f"{_SENT}; the EKF uses them as if they were newer",
              "compare with landmarks; on the ground raise delay_ms and the autopilot's delay "
              "parameter"),
    condition(A.FIXES_OVER_LIMIT, WARNING, "fixes {age_ms:.0f} ms old, limit {limit_ms:.0f}",
              {"age_ms": "ms", "limit_ms": "ms"},
              "the median age of the last 50 fixes is above what the firmware can use (ArduPilot "
              "250 ms, PX4 300 ms)",
              "it is below 90 % of the limit for 15 s",
              "fixes are extrapolated by at most 0.5 s and sent; older ones are not sent",
              "compare with landmarks; on the ground use a faster computer or a smaller "
              "`localizer.width`"),
    event(A.FIXES_IN_TIME, INFO, "fixes are in time again", {},
          "no late fix for 15 s (up to 60 s if it recurs)", "delay_ms is right again",
          _NONE),
    condition(A.YAW_UNCHECKED, WARNING, "yaw not checked: no attitude or gimbal", {},
              "for 20 fixes in a row the attitude or the gimbal angles at their time are missing",
              "a fix has both",
              f"{_SENT}, but a wrong yaw would not be detected; with message odometry, missing "
              "attitude stops them (`no_attitude`); an active `yaw_mismatch` stays active",
              f"{_LANDMARKS}; after landing check the rates of ATTITUDE and of the gimbal's "
              "messages",
              "vision yaw is checked"),
    condition(A.CLOCK_NOT_SET, WARNING, "clock not set: GPS_INPUT has no time", {},
              "with message gps_input: the companion's clock is before 2023", "the "
              "clock is set",
              f"{_SENT}, without a time", "set the companion's clock, for example by NTP"),
    event(A.TLOG_INCOMPLETE, WARNING, "tlog is incomplete: {why}", {"why": "name"},
          "the .tlog (`bridge.tlog`) cannot be written", "MAVLink messages are not recorded",
          "check the disk after landing"),
)  # fmt: skip
