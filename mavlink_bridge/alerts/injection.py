"""Alerts about the positions that are sent, and about the EKF's reaction."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import NOTHING, WHILE, AlertSpec, Kind, Severity, condition, event
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import CommandAnswer, InjectionOrder, RcChannel

WARNING, NOTICE, INFO = Severity.WARNING, Severity.NOTICE, Severity.INFO
_NOT_SENT, _NOT_READY = "not sent: ", "not ready: "
_TAKE_OVER = "take over"
_DOCTOR = "after landing run `companion doctor`"
_LANDMARKS = "check landmarks"
_MAP = "check map and calibration"
_NOT_FAILED = "the check has not failed: without GNSS injection starts, unverified"
_WITHIN = "50 or more compared fixes are within the limit; it stays while fewer are compared"
_FAILED = "the check has failed: injection does not start, also without GNSS"
_SENT_UNVERIFIED = "unverified fixes are sent"
_NOT_USED = "the EKF uses no fix"
_BY: dict[str, Kind] = {"by": (InjectionOrder, RcChannel)}

INJECTION: tuple[AlertSpec, ...] = (
    event(A.INJECTING, INFO, "injecting", {},
          "injection sends its first fix, or *not sent* has ended for 1.5 s",
          "the autopilot receives fixes", NOTHING),
    condition(A.NO_FIX_YET, WARNING, "no fix yet", {},
              "no fix has passed the checks since the start; no text, only `inject_reason` in "
              "health.json",
              WHILE, "vision has found no position, or its fixes are held", _TAKE_OVER,
              lead=_NOT_SENT),
    condition(A.NO_FRESH_FIX, WARNING, "no fresh fix", {},
              "nothing was sent for 1 s, because the newest checked fix is older than "
              "`bridge.injection.delay_ms` + 0.5 s, or none came for twice the usual interval",
              "a fix passes the checks",
              "vision makes no fix (a localization text says why), or fixes are held or dropped "
              "(`fixes_not_checked`)",
              f"act on an active \"output held\"; otherwise {_TAKE_OVER}",
              lead=_NOT_SENT),
    condition(A.LINK_FULL, WARNING, "the link takes no more", {},
              "injection is on, and for 1 s the port to the autopilot takes no fix", WHILE,
              "the connection is too slow or broken", f"{_TAKE_OVER}; check cable and baud rate",
              lead=_NOT_SENT),
    condition(A.COMMAND_NOT_TAKEN, WARNING, "command {answer}", {"answer": CommandAnswer},
              "injection is on with message external_position_estimate, and for 2 s the autopilot "
              "has not accepted this command", WHILE,
              "*not asked, no GNSS*: a test command follows when the EKF uses GNSS; *not "
              "answered*: another each second; others: this firmware does not use it, and is asked "
              "again only after a reboot, or each second if it accepted before",
              f"{_TAKE_OVER}; if not asked wait for GNSS, else set another message",
              lead=_NOT_SENT),
    condition(A.EKF_NO_ORIGIN, WARNING, "the EKF has no origin", {},
              "with message vision_position_estimate or odometry, the autopilot sends no "
              "GPS_GLOBAL_ORIGIN", WHILE,
              "positions in these messages are relative to the origin",
              f"{_TAKE_OVER}; set the origin at the ground station, or `bridge.origin`",
              lead=_NOT_SENT),
    condition(A.EKF_ORIGIN_FAR, WARNING, "EKF origin {kilometres:.0f} km away",
              {"kilometres": "km"}, "the EKF origin is over 100 km from a fix", WHILE,
              "origin or map is wrong", f"{_TAKE_OVER}; check both", lead=_NOT_SENT),
    condition(A.NO_ATTITUDE, WARNING, "no attitude for ODOMETRY", {},
              "with message odometry, ATTITUDE is missing for the time of a fix", WHILE,
              "ODOMETRY must contain the attitude",
              f"{_TAKE_OVER}; check the rate of ATTITUDE", lead=_NOT_SENT),
    condition(A.SIGMA_OVER_LIMIT, WARNING, "sigma {metres:.1f} m over limit", {"metres": "m"},
              "the horizontal sigma N of a fix is above 10 m", WHILE,
              "the position is too uncertain; during `bridging` ArduPilot still receives the "
              "velocity",
              _TAKE_OVER,
              lead=_NOT_SENT),
    condition(A.YAW_MISMATCH, WARNING, "vision yaw {degrees:+.0f} deg off autopilot",
              {"degrees": "deg"},
              "in three of five fixes vision's yaw is over 20 deg off the autopilot's, or turned "
              "over 3.5 deg unlike the gyros; at the start, or after 60 s without a good fix, is "
              "over 3.5 deg off the autopilot's",
              "five fixes in a row are within 2.5 in place of 3.5 deg",
              "compass, camera mounting or map is rotated; N: vision minus autopilot, small if "
              "only the turn is wrong",
              f"{_TAKE_OVER}; check compass and camera mounting", lead=_NOT_SENT),
    condition(A.INHIBITED, WARNING, "{alert}", {"alert": A},
              "in mode inject, before injection, an alert that inhibits (ALERT: `focal_length`, "
              "`boresight`, `time_offset`) is active, although fixes are made for 10 s", WHILE,
              "injection does not start", f"act on that alert; {_TAKE_OVER}", lead=_NOT_SENT),
    condition(A.SHADOW_NOT_COMPARED, WARNING, "no fix compared with GNSS", {},
              "no fix of the last 2 min was compared", WHILE,
              f"no fix, or the EKF does not use GNSS; {_NOT_FAILED}",
              "wait; check that GNSS has a 3D fix", lead=_NOT_READY),
    condition(A.SHADOW_FEW_FIXES, WARNING, "{fixes:.0f} of {needed:.0f} fixes",
              {"fixes": "fixes", "needed": "fixes"},
              "fewer than 50 fixes of the last 2 min were compared", WHILE, _NOT_FAILED, "wait",
              lead=_NOT_READY),
    condition(A.SHADOW_RATE, WARNING, "fix rate {hertz:.1f} Hz, needs {needed:.0f}",
              {"hertz": "Hz", "needed": "Hz"},
              "fewer than 4 fixes a second were compared, and nothing else fails", WHILE,
              f"there are too few fixes for the EKF; {_NOT_FAILED}", "check the computer's load",
              lead=_NOT_READY),
    condition(A.SHADOW_MEDIAN, WARNING, "median error {metres:.1f} m", {"metres": "m"},
              "the median horizontal difference N is above 3 m", _WITHIN,
              f"the map may have an offset; {_FAILED}", _MAP, lead=_NOT_READY),
    condition(A.SHADOW_P95, WARNING, "p95 error {metres:.1f} m", {"metres": "m"},
              "5 % of the horizontal differences exceed N, which is above 6 m", _WITHIN,
              f"some fixes are wrong; {_FAILED}", _MAP, lead=_NOT_READY),
    condition(A.SHADOW_COVARIANCE, WARNING, "error over claimed covariance", {},
              "the median horizontal difference is over three times what the covariance predicts",
              _WITHIN, f"fixes are less accurate than they state; {_FAILED}", _MAP,
              lead=_NOT_READY),
    condition(A.SHADOW_HEIGHT, WARNING, "height {metres:+.0f} m; check geoid", {"metres": "m"},
              "the median height difference N (vision minus EKF) exceeds 10 m", _WITHIN,
              f"geoid, vertical datum or barometer is wrong; {_FAILED}", _MAP,
              lead=_NOT_READY),
    condition(A.SHADOW_YAW, WARNING, "yaw differs by {degrees:+.1f} deg", {"degrees": "deg"},
              "`yaw_mismatch` has ended (while it is active, its own text is sent)",
              "50 fixes of the last 2 min are compared",
              f"compass or camera mounting is wrong; {_FAILED}",
              "check compass and camera mounting", lead=_NOT_READY),
    condition(A.SHADOW_RESTORED, WARNING, "failed before the restart", {},
              "at a restart: with this map the check had failed, before injection, in a process "
              "that crashed or was killed at most 10 min ago",
              "50 fixes are compared, with their own result", "the failure stands until then; "
              "injection does not start without GNSS", _MAP, lead=_NOT_READY),
    event(A.INJECTION_FORCED, WARNING, "injection forced, no shadow check", {},
          "`bridge.injection.force` starts injection without a valid pass, or although an alert "
          "inhibits", _SENT_UNVERIFIED,
          f"{_LANDMARKS}; land, unless this flight tests `force`, and remove it"),
    event(A.INJECTION_NOT_READY, WARNING, "injecting although not ready", {},
          "mode rc: the pilot enables injection without a valid pass, or although an alert "
          "inhibits", _SENT_UNVERIFIED, _LANDMARKS),
    event(A.INJECTION_UNCHECKED, WARNING, "injecting without shadow check", {},
          "mode inject: injection starts without a valid pass, because GNSS had no 3D fix for 2 "
          "s, the check has not failed, and no alert inhibits", _SENT_UNVERIFIED, _LANDMARKS),
    event(A.INJECTION_ON, NOTICE, "injection on ({by})", _BY,
          "mode rc: RC channel or command (BY) enables injection",
          "fixes are sent", NOTHING),
    event(A.INJECTION_OFF, NOTICE, "injection off, shadow ({by})", _BY,
          "mode rc: the program starts, or RC channel or command disables injection (BY)",
          "no fixes are sent, only compared with GNSS", _TAKE_OVER),
    event(A.INJECTION_RESTORED, NOTICE, "injection on (restored, {seconds:.0f} s old)",
          {"seconds": "s"},
          "mode rc: a process that crashed or was killed N s ago (10 min at most) had injection "
          "enabled", "fixes are sent", NOTHING),
    event(A.JUMP_REPEATED, NOTICE, "the EKF missed a jump: announced again", {},
          "after `reset_counter` incremented, the EKF is still over 1 m + 3 sigma off the fixes",
          "the EKF has not jumped to the fixes; the next one increments it again, five times at "
          "most", NOTHING),
    event(A.EKF_FOLLOWS, INFO, "the EKF follows", {},
          "no *EKF check* fails, and `ekf_jump` is not active: 3 s after the first sent fix, after "
          "the end of such an alert, or 3.5 s after `reset_counter` incremented, once the EKF is "
          "within 1 m + 3 sigma",
          "the EKF is where the fixes are", NOTHING),
    condition(A.FIX_RATE_LOW, WARNING, "fix rate {hertz:.1f} Hz, needs {needed:.1f}",
              {"hertz": "Hz", "needed": "Hz"},
              "positions are sent at less than 4 Hz (message gps_input: 4.65 Hz; EKF check)", WHILE,
              "they are sent, but the EKF may stop using them",
              f"{_LANDMARKS}; on the ground check the computer's load"),
    condition(A.EKF_NOT_INITIALISED, WARNING, "the EKF is not initialised yet", {},
              "ArduPilot's EKF flag EKF_UNINITIALIZED is set (EKF check)", WHILE, _NOT_USED,
              _TAKE_OVER),
    condition(A.EKF_NO_SOURCE, WARNING, "the EKF has no position source", {},
              "the EKF flag EKF_CONST_POS_MODE is set (EKF check)", WHILE, _NOT_USED,
              f"{_TAKE_OVER}; {_DOCTOR}"),
    condition(A.EKF_NO_POSITION, WARNING, "the EKF reports no local position", {},
              "LOCAL_POSITION_NED is missing for the fixes' times (EKF check)", WHILE,
              "whether the EKF uses the fixes is unknown", f"{_TAKE_OVER}; {_DOCTOR}"),
    condition(A.EKF_OFF_FIXES, WARNING, "the EKF is {metres:.1f} m from what is sent",
              {"metres": "m"},
              "the EKF's median distance N from the fixes is above 2 m + 5 sigma (EKF check)",
              WHILE,
              "source set, EKF origin or yaw is wrong", f"{_LANDMARKS}; {_DOCTOR}"),
    condition(A.EKF_REJECTS_FIXES, WARNING, "the EKF rejects positions", {},
              "the test ratio is above 1 (EKF check)", WHILE, _NOT_USED,
              f"{_TAKE_OVER}; after landing check VISO_POS_M_NSE and the delay"),
    condition(A.FIXES_LATE, WARNING, "fixes {age_ms:.0f} ms old, delay_ms {limit_ms:.0f}",
              {"age_ms": "ms", "limit_ms": "ms"},
              "each of the last 50 fixes (not ArduPilot: their median) is over "
              "`bridge.injection.delay_ms` + 10 ms old when made",
              "for 15 s the age is below 90 % of it; `fixes_in_time` follows",
              "fixes are sent, but the EKF takes them for newer",
              f"{_LANDMARKS}; on the ground raise delay_ms and the autopilot's delay"),
    condition(A.FIXES_OVER_LIMIT, WARNING, "fixes {age_ms:.0f} ms old, limit {limit_ms:.0f}",
              {"age_ms": "ms", "limit_ms": "ms"},
              "the median age of 50 fixes is above what the firmware can use (250 ms, PX4 300 ms)",
              "for 15 s it is below 90 % of it; `fixes_in_time` follows",
              "in their place positions extrapolated by up to 0.5 s are sent",
              f"{_LANDMARKS}; on the ground use a faster computer or a smaller `localizer.width`"),
    event(A.FIXES_IN_TIME, INFO, "fixes are in time again", {},
          "after `fixes_late` or `fixes_over_limit`: no late fix for 15 s",
          "fixes are young enough again",
          NOTHING),
    condition(A.YAW_UNCHECKED, WARNING, "yaw not checked: no attitude or gimbal", {},
              "for 20 fixes in a row the attitude or the gimbal angles are missing",
              "a fix has both",
              "fixes are sent, but a wrong yaw would not be detected; an active `yaw_mismatch` "
              "stays",
              f"{_LANDMARKS}; after landing check the rates of these messages",
              "vision yaw is checked"),
    condition(A.CLOCK_NOT_SET, WARNING, "clock not set: GPS_INPUT has no time", {},
              "message gps_input: at the start the companion's clock is before 2023",
              "a restart with a set clock",
              "fixes are sent without a time", "set the clock and restart"),
    event(A.TLOG_INCOMPLETE, WARNING, "tlog incomplete: {why}", {"why": "name"},
          "the .tlog (`bridge.tlog`) cannot be written, or has 2 GiB; once",
          "MAVLink messages from then on are missing in it", "check the disk"),
)  # fmt: skip
