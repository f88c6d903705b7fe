"""Alerts about the vehicle, its link, and other senders on it."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import AlertSpec, Severity, condition, event
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
_SIGN = "check the wiring; if it is right, sign the link"
_NONE = "nothing"
_SENT = "fixes continue"
_TAKE_OVER = "take over"
_CHECK_LINK = "check the link between computer and flight controller"
_WHERE = "a ground station sees this text only over `bridge.ground_connection`"
_SET = "check the EKF source set"

VEHICLE: tuple[AlertSpec, ...] = (
    event(A.FC_FOUND, INFO, "flight controller found", {}, "the first heartbeat of the autopilot",
          "the MAVLink link works",
          _NONE),
    condition(A.FC_LOST, WARNING, "flight controller lost: no heartbeat 3 s", {},
              "no heartbeat for 3 s, after there were some", "a heartbeat is received (`fc_back`)",
              f"no fix reaches the autopilot; {_WHERE}", f"{_TAKE_OVER}; {_CHECK_LINK}"),
    event(A.FC_BACK, INFO, "flight controller is back", {}, "a heartbeat after `fc_lost`",
          "the MAVLink link works again", _NONE),
    condition(A.FC_SILENT, WARNING, "no heartbeat from the flight controller", {},
              "text: no heartbeat in the first 5 s after the start; in health.json: whenever there "
              "was no heartbeat for 3 s", "a heartbeat is received",
              f"no fix reaches the autopilot; {_WHERE}", f"{_TAKE_OVER}; {_CHECK_LINK}"),
    event(A.FC_REBOOTED, WARNING, "flight controller rebooted", {},
          "the boot time in its messages ran back",
          "the EKF has restarted with its first source set; fixes in messages relative to the EKF "
          "origin are sent when the origin is known again",
          _SET),
    condition(A.GNSS_LOST, WARNING, "GNSS lost, {output}", {"output": Output},
              "no 3D fix for 1 s in total (each second with a 3D fix cancels 0.25 s), or no GNSS "
              "report for 2.5 s",
              "a 3D fix for 5 s, and no `gnss_refused`",
              "*injecting*: fixes continue; *nothing is injected*: the EKF has no position",
              "*injecting*: nothing; *nothing is injected*: take over"),
    event(A.GNSS_BACK, INFO, "GNSS is back", {},
          "after `gnss_lost`: a 3D fix for 5 s, and no `gnss_refused`", "GNSS can be used again",
          "select the GNSS source set if you want it"),
    event(A.ARMED_WITHOUT_GNSS, WARNING, "armed without GNSS, {output}", {"output": Output},
          "at arming, or at the start of the program with an armed vehicle: no 3D fix within 1.5 "
          "s (no GNSS report yet: 3 s)",
          "*injecting*: fixes continue, but cannot be compared with GNSS; *nothing is injected*: "
          "the EKF has no position",
          "on the ground: do not take off unless this is planned; in flight, *nothing is "
          "injected*: take over"),
    event(A.SENDER_IGNORED, WARNING, "MAVLink of {sender} ignored", {"sender": "name"},
          "on UDP, MAVLink arrives from an address other than `bridge.sender` (if that is not set: "
          "than the first autopilot's); on `bridge.ground_connection`: than the first ground "
          "station's",
          "messages from this address are ignored; if it is the autopilot's, no fix reaches it",
          "if it is the autopilot's address, set `bridge.sender` to it; else find this sender"),
    event(A.GIMBAL_IGNORED, WARNING, "gimbal {component}, device {device} ignored",
          {"component": "id", "device": "id"}, "a second gimbal reports its attitude",
          f"{_SENT}; only the angles of the first gimbal are used",
          "set `bridge.camera.gimbal_component`"),
    event(A.SECOND_COMPANION, WARNING, "another companion is component {component}",
          {"component": "id"}, "a heartbeat with this program's own ids is received",
          f"{_SENT}; another program uses the same ids and may send fixes too",
          "take over; stop one of them"),
    event(A.DUPLICATE_SYSTEM_ID, WARNING, "two autopilots have system id {system}",
          {"system": "id"},
          "heartbeats of a second autopilot or of another make, another firmware version, or boot "
          "times that run back 40 times in 5 s",
          f"{_SENT}; the data of both autopilots are mixed", "take over; on the ground change the "
          "system id of one"),
    event(A.AUTOPILOT_IGNORED, WARNING, "autopilot {system} ignored, using {used}",
          {"system": "id", "used": "id"}, "heartbeats of an autopilot with another system id, "
          "while `bridge.system_id` is not set",
          f"{_SENT}; the messages of this autopilot are ignored",
          "set `bridge.system_id` to your vehicle's"),
    event(A.ARMING_ALTERNATES, WARNING, "system {system} armed, disarmed in turn", {"system": "id"},
          "heartbeats alternate between armed and disarmed three times in 10 s",
          f"{_SENT}; another sender may forge heartbeats",
          _SIGN),
    event(A.TIMESYNC_CONTRADICTS, WARNING, "TIMESYNC contradicts time stamps", {},
          "three answers in 10 s do not fit the timestamps of the autopilot",
          f"{_SENT}; two systems may answer", _SIGN),
    condition(A.TIMESYNC_UNANSWERED, WARNING, "TIMESYNC unanswered: stamps may drift", {},
              "no answer for 15 s, after earlier answers and although other messages are received",
              "an answer is received",
              f"{_SENT}; the error of their times grows by up to 0.2 ms per second",
              _CHECK_LINK,
              "TIMESYNC is answered again"),
    event(A.ORIGIN_REFUSED, WARNING, "EKF origin refused: {metres:.0f} m off", {"metres": "m"},
          "GPS_GLOBAL_ORIGIN changes while armed",
          f"{_SENT}, relative to the previous origin; somebody may forge the message",
          _SIGN),
    event(A.ORIGIN_MOVED, INFO, "EKF origin moved; positions follow it", {},
          "GPS_GLOBAL_ORIGIN changes while disarmed", f"{_SENT}, relative to the new origin",
          _NONE),
    event(A.ORIGIN_KNOWN, INFO, "EKF origin known", {},
          "the first GPS_GLOBAL_ORIGIN after the start, a reboot or a lost link",
          "fixes relative to the EKF origin can be sent", _NONE),
    event(A.ORIGIN_DIFFERS, INFO, "EKF origin {metres:.0f} m from configured one", {"metres": "m"},
          "the first GPS_GLOBAL_ORIGIN is over 1 m from `bridge.origin`",
          f"{_SENT}, relative to the EKF's origin",
          "check `bridge.origin`"),
    condition(A.UNKNOWN_FIRMWARE, WARNING, "unknown firmware, using the safe profile", {},
              "AUTOPILOT_VERSION is neither ArduPilot 4.5 or newer nor PX4 1.15 or newer",
              "AUTOPILOT_VERSION names a known firmware",
              f"{_SENT}, with the most cautious settings",
              "check the firmware's version"),
    condition(A.MESSAGE_UNSUPPORTED, WARNING, "unsupported: {message}", {"message": "name"},
              "the firmware does not support the message of `bridge.injection.message`",
              "AUTOPILOT_VERSION names a firmware that supports it",
              "the EKF receives no fix that it can use",
              f"{_TAKE_OVER}; set another message"),
    event(A.SOURCE_SET_UNKNOWN, WARNING, "EKF source set not known: met in flight", {},
          "ArduPilot is armed already at its first heartbeat, for example after a crash of the "
          "companion",
          "until ArduPilot reports its set or accepts a command to select one, the program does "
          "not return to good GNSS (`return_to_gnss`); with `bridge.switch.enabled` it still "
          "selects vision if GNSS fails, and GNSS if vision ends",
          "select the set that you want with the RC switch; ArduPilot's report makes it known"),
    event(A.SOURCE_SET_SELECTED, WARNING, "EKF source set {source_set}: {cause}",
          {"source_set": "", "cause": (GnssProblem, ReturnCause), "metres": "m"},
          "`bridge.switch.enabled`: the companion sends the command to select this set. To the "
          "vision set: GNSS was lost, glitched or was far from vision for 1.5 s, and fixes are "
          "sent. To the GNSS set, unless the pilot selected the vision set: (1) `return_to_gnss` "
          "is set, and GNSS agrees with vision and IMU for 5 s; or (2) no fix was sent for 3 s, "
          "and GNSS has worked for 3 s, is within 25 m of the EKF's position and not refused",
          "the EKF uses this set, unless `source_set_refused` follows; *vision lost*: no fix is "
          "sent",
          "compare the position with landmarks"),
    event(A.SOURCE_SET_REFUSED, WARNING, "source switch refused", {},
          "the autopilot refuses the command to select a source set",
          "the EKF stays on its set; while the cause lasts, the command is repeated every second, "
          "and this text after each refusal",
          "select the set that `source_set_selected` named"),
    condition(A.SOURCE_SET_HELD, WARNING, "no switch: {cause}, {why}",
              {"cause": GnssProblem, "metres": "m", "why": (SwitchRefusal, ChosenSet)},
              "`bridge.switch.enabled`: GNSS is lost, glitches or is far from vision for 1.5 s, "
              "but the vision set must not be selected; again every 10 s",
              "GNSS is right again, or the vision set is selected",
              "the EKF stays on its source set; *not ready*: no valid pass of the shadow check, or "
              "an alert inhibits; *EKF with GNSS*: the EKF's position is nearer to GNSS than to "
              "vision; *set N chosen*: the pilot selected it",
              "decide by landmarks which source is right, and select it"),
    event(A.LOOK_AT_REFUSED, WARNING, "look-at refused: {why}", {"why": LookAtRefusal},
          "a command to point the gimbal cannot be carried out",
          "the command changes nothing: if the gimbal follows an earlier target, it goes on",
          "correct what the text names"),
    event(A.LOOK_AT_NO_TARGET, WARNING, "look-at refused: no target {number}", {"number": ""},
          "a command points the gimbal at a target that does not exist",
          "the command changes nothing: if the gimbal follows an earlier target, it goes on",
          "give the number of an existing target"),
    event(A.LOOK_AT_UNANSWERED, WARNING, "autopilot does not answer look-at", {},
          "the autopilot does not answer the gimbal command for 3 s", "the gimbal may not move",
          "check the gimbal's parameters (MNT1_*)"),
    event(A.LOOK_AT_DENIED, WARNING, "autopilot: look-at {result}", {"result": CommandAnswer},
          "the autopilot refuses the gimbal command", "the gimbal does not move",
          "check the gimbal's parameters (MNT1_*)"),
    event(A.LOOK_AT_ENDED, INFO, "target {number} ended, the gimbal stays", {"number": ""},
          "the target that the gimbal followed has ended",
          "the gimbal keeps its last direction",
          "select another target"),
    event(A.SENDER_REFUSED, WARNING, "system {system} refused: {why}",
          {"system": "id", "why": SenderRefusal},
          "a system that is not allowed to do so sends a command; once for each system",
          "its commands are denied",
          "if it is yours: add it to `bridge.ground_systems`, or sign its link"),
    event(A.SENDERS_REFUSED, WARNING, "system {system} and more refused: {why}",
          {"system": "id", "why": SenderRefusal},
          "a fourth system that is not allowed to do so sends a command; further ones are not "
          "reported",
          "their commands are denied",
          "if they are yours: add them to `bridge.ground_systems`, or sign their link"),
    event(A.HINT_TAKEN, NOTICE, "search near given position, +-{metres:.0f} m", {"metres": "m"},
          "the ground station sends an approximate position (MAV_CMD_EXTERNAL_POSITION_ESTIMATE "
          "to the localizer); N: its sigma, at least 10 m, 100 m if none is given",
          "searches of the next 2 min look within 2 N of it; it is never sent as a fix",
          _NONE),
    event(A.HINT_REFUSED, WARNING, "hint refused: not on the map", {},
          "the position that the ground station sent is farther from the map than twice its stated "
          "accuracy",
          "the search continues without it",
          "send a position on the map"),
)  # fmt: skip
