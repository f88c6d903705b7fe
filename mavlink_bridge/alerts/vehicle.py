"""Alerts about the vehicle, its link, and other senders on it."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import NOTHING, WHILE, AlertSpec, Severity, condition, event
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import (
    ChosenSet,
    CommandAnswer,
    GnssProblem,
    LookAtRefusal,
    Output,
    ReturnCause,
    SenderRefusal,
    SwitchRefusal,
)

WARNING, NOTICE, INFO = Severity.WARNING, Severity.NOTICE, Severity.INFO
_SIGN = "check the wiring; sign the link"
_TAKE_OVER = "take over"
_LANDMARKS = "check landmarks"
_CABLE = "take over; check the link to the flight controller"
_NO_LINK = "no fix reaches the autopilot; the text comes only over `bridge.ground_connection`"
_AS_BEFORE = "nothing changes: a gimbal that follows a target goes on"
_MOUNT = "check the gimbal's MNT1 parameters"
_SENT_OR_NOT = (
    "*injecting*: fixes are sent, and the EKF uses them if its source set is vision (PX4, "
    "gps_input: always); *nothing is injected*: it has no position"
)
_SELECT = "if injecting, select the vision source set, unless it is selected; otherwise take over"

VEHICLE: tuple[AlertSpec, ...] = (
    event(A.FC_FOUND, INFO, "flight controller found", {}, "the autopilot's first heartbeat",
          "MAVLink works", NOTHING),
    condition(A.FC_LOST, WARNING, "flight controller lost: no heartbeat 3 s", {},
              "no heartbeat of the autopilot for 3 s, after earlier ones", "`fc_back`", _NO_LINK,
              _CABLE),
    event(A.FC_BACK, INFO, "flight controller is back", {}, "a heartbeat after `fc_lost`",
          "MAVLink works again and injection goes on; messages relative to the EKF origin wait "
          "for `origin_known`", NOTHING),
    condition(A.FC_SILENT, WARNING, "no heartbeat from the flight controller", {},
              "no heartbeat of the autopilot in the first 5 s (in health.json: for 3 s at any "
              "time)",
              "`fc_found`", _NO_LINK, _CABLE),
    event(A.FC_REBOOTED, WARNING, "flight controller rebooted", {},
          "the boot time in its messages ran back",
          "the EKF restarted with its first source set; injection goes on, but messages relative "
          "to the EKF origin wait for `origin_known`",
          "check the EKF source set"),
    condition(A.GNSS_LOST, WARNING, "GNSS lost, {output}", {"output": Output},
              "GNSS had a 3D fix, and has none for 1 s (brief ones do not reset the count), or no "
              "report came for 2.5 s",
              "`gnss_back`", _SENT_OR_NOT,
              _SELECT),
    event(A.GNSS_BACK, INFO, "GNSS is back", {},
          "after `gnss_lost`: a 3D fix for 5 s, and no `gnss_refused`",
          "GNSS can be used again; the program selects it only as `source_set_selected` says",
          "select the GNSS source set if you want it"),
    event(A.ARMED_WITHOUT_GNSS, WARNING, "armed without GNSS, {output}", {"output": Output},
          "at arming, or when the program meets an armed vehicle: the newest GNSS report "
          "has no 3D fix or is over 1.5 s old",
          _SENT_OR_NOT,
          f"on the ground: do not take off unless planned; in flight: {_SELECT}"),
    event(A.SENDER_IGNORED, WARNING, "MAVLink of {sender} ignored", {"sender": "name"},
          "UDP: MAVLink arrives from another host or port than `bridge.sender` or, if not set, the "
          "first autopilot (`bridge.ground_connection`: the first ground station, until it is "
          "silent for 10 s); SENDER: its host; each once, four at most",
          "it is ignored; if it is the autopilot's, no fix reaches it",
          "set `bridge.sender` to the autopilot's address; find the sender"),
    event(A.GIMBAL_IGNORED, WARNING, "gimbal {component}, device {device} ignored",
          {"component": "id", "device": "id"}, "a second gimbal reports its attitude; once",
          "only the first gimbal's angles are used, while it sends",
          "set `bridge.camera.gimbal_component` and `gimbal_device` to the camera's gimbal"),
    event(A.SECOND_COMPANION, WARNING, "another companion is component {component}",
          {"component": "id"}, "a heartbeat with this program's own ids is received; once",
          "another program uses the same ids, and may send fixes too",
          f"{_TAKE_OVER}; stop one of them"),
    event(A.DUPLICATE_SYSTEM_ID, WARNING, "two autopilots have system id {system}",
          {"system": "id"},
          "this id comes from a second component, make or firmware version of autopilot, or boot "
          "times alternate; once",
          "the data of both may be mixed: positions may be checked against the other vehicle",
          f"{_TAKE_OVER}; on the ground change one system id"),
    event(A.AUTOPILOT_IGNORED, WARNING, "autopilot {system} ignored, using {used}",
          {"system": "id", "used": "id"}, "an autopilot with another system id is heard, and "
          "`bridge.system_id` is not set; once",
          "its messages are ignored; fixes go to the one in use",
          "set `bridge.system_id` to your vehicle's"),
    event(A.ARMING_ALTERNATES, WARNING, "system {system} armed, disarmed in turn", {"system": "id"},
          "the autopilot's heartbeats change from armed to disarmed three times in 10 s; once",
          "another sender may forge heartbeats; the vehicle counts as armed",
          _SIGN),
    event(A.TIMESYNC_CONTRADICTS, WARNING, "TIMESYNC contradicts time stamps", {},
          "three answers in 10 s are over 10 s off the autopilot's timestamps; once",
          "a second system may answer; its answers are ignored", _SIGN),
    condition(A.TIMESYNC_UNANSWERED, WARNING, "TIMESYNC unanswered: stamps may drift", {},
              "no answer for 15 s, after earlier ones, although heartbeats arrive",
              "an answer",
              "the fixes' times drift by up to 0.2 ms per second",
              "check the link to the flight controller",
              "TIMESYNC is answered again"),
    event(A.ORIGIN_REFUSED, WARNING, "EKF origin refused: {metres:.0f} m off", {"metres": "m"},
          "GPS_GLOBAL_ORIGIN (the EKF origin) changes by N while armed; once",
          "fixes stay relative to the previous origin; somebody may forge the message",
          _SIGN),
    event(A.ORIGIN_MOVED, INFO, "EKF origin moved; positions follow it", {},
          "GPS_GLOBAL_ORIGIN changes while disarmed", "fixes are relative to the new origin",
          NOTHING),
    event(A.ORIGIN_KNOWN, INFO, "EKF origin known", {},
          "the first GPS_GLOBAL_ORIGIN after the start, a reboot or a lost link",
          "messages vision_position_estimate and odometry, which are relative to it, can be sent",
          NOTHING),
    event(A.ORIGIN_DIFFERS, INFO, "EKF origin {metres:.0f} m from configured one", {"metres": "m"},
          "in place of `origin_known`: the EKF origin is over 1 m from `bridge.origin`",
          "fixes are sent, relative to the EKF's origin, which GNSS may have set",
          "check `bridge.origin`"),
    condition(A.UNKNOWN_FIRMWARE, WARNING, "unknown firmware, using the safe profile", {},
              "AUTOPILOT_VERSION names neither ArduPilot 4.5 or newer nor PX4 1.15 or newer; "
              "its end is not sent",
              WHILE, "fixes are sent with the most cautious settings; only message "
              "vision_position_estimate is known to work",
              "check its version"),
    condition(A.MESSAGE_UNSUPPORTED, WARNING, "unsupported: {message}", {"message": "name"},
              "the firmware does not support `bridge.injection.message`", WHILE,
              "fixes are sent, but the EKF cannot use them",
              f"{_TAKE_OVER}; set another message"),
    event(A.SOURCE_SET_UNKNOWN, WARNING, "EKF source set not known: met in flight", {},
          "ArduPilot is armed at its first heartbeat, for example after a crash of the companion",
          "until ArduPilot reports a set or accepts one by command, `return_to_gnss` does nothing; "
          "with `bridge.switch.enabled` vision is still selected if GNSS fails, and GNSS if vision "
          "ends",
          "select a set by RC switch: ArduPilot reports it"),
    event(A.SOURCE_SET_SELECTED, WARNING, "EKF source set {source_set}: {cause}",
          {"source_set": "", "cause": (GnssProblem, ReturnCause), "metres": "m"},
          "`bridge.switch.enabled`: the program selects a set. Vision: GNSS was lost, glitched or "
          "over 5 sigma from vision for 1.5 s, fixes are sent, and `source_set_held` does not "
          "apply. GNSS, unless the pilot selected vision: with `return_to_gnss` after 5 s of "
          "agreement with vision and IMU; or (*vision lost*) no fix was sent for 3 s, and GNSS "
          "worked for 3 s, within 25 m of the EKF and not refused",
          "the EKF uses this set, unless `source_set_refused` follows", _LANDMARKS),
    event(A.SOURCE_SET_REFUSED, WARNING, "source switch refused", {},
          "the autopilot refuses the program's command to select a source set",
          "the EKF stays on its set; the command and this text are repeated every second while "
          "the cause lasts",
          "select the set that `source_set_selected` named"),
    condition(A.SOURCE_SET_HELD, WARNING, "no switch: {cause}, {why}",
              {"cause": GnssProblem, "metres": "m", "why": (SwitchRefusal, ChosenSet)},
              "with `bridge.switch.enabled`, GNSS is lost, glitches or is over 5 sigma from vision "
              "for 1.5 s, but vision must not be selected; repeated every 10 s, its end is not "
              "sent", WHILE,
              "the EKF stays on its set. *not ready*: no valid pass, or an alert inhibits; *EKF "
              "with GNSS*: it is nearer to GNSS than to vision; *set N chosen*: by the pilot",
              "select the source that landmarks confirm"),
    event(A.LOOK_AT_REFUSED, WARNING, "look-at refused: {why}", {"why": LookAtRefusal},
          "a command to point the gimbal cannot be carried out", _AS_BEFORE,
          "correct what the text names"),
    event(A.LOOK_AT_NO_TARGET, WARNING, "look-at refused: no target {number}", {"number": ""},
          "a command names a target that does not exist", _AS_BEFORE,
          "give the number of a target"),
    event(A.LOOK_AT_UNANSWERED, WARNING, "autopilot does not answer look-at", {},
          "the autopilot does not answer the gimbal command for 3 s", "the gimbal may not move",
          _MOUNT),
    event(A.LOOK_AT_DENIED, WARNING, "autopilot: look-at {result}", {"result": CommandAnswer},
          "the autopilot refuses the gimbal command",
          "the gimbal does not move; a followed target is not followed any more", _MOUNT),
    event(A.LOOK_AT_ENDED, INFO, "target {number} ended, the gimbal stays", {"number": ""},
          "the target that the gimbal followed has ended", "the gimbal keeps its direction",
          "select another target"),
    event(A.SENDER_REFUSED, WARNING, "system {system} refused: {why}",
          {"system": "id", "why": SenderRefusal},
          "a system that may not do so sends a command; once for each",
          "its commands are denied",
          "if it is yours: add it to `bridge.ground_systems` (not allowed), or sign its link (not "
          "signed)"),
    event(A.SENDERS_REFUSED, WARNING, "system {system} and more refused: {why}",
          {"system": "id", "why": SenderRefusal},
          "a fourth system (N) sends a command that it may not; further ones are not reported "
          "until a restart",
          "their commands are denied",
          "add yours to `bridge.ground_systems`, or sign their links"),
    event(A.HINT_TAKEN, NOTICE, "search near given position, +-{metres:.0f} m", {"metres": "m"},
          "a ground station gives the position by MAVLink; N: its sigma, at least 10 m, without "
          "one 100 m",
          "searches of the next 2 min look only within 2 N", NOTHING),
    event(A.HINT_REFUSED, WARNING, "hint refused: not on the map", {},
          "the given position is over two of its sigmas off the map",
          "the search ignores it", "give a position on the map"),
)  # fmt: skip
