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
_SENT = "fixes are sent"
_BY_HAND = "without GNSS fly in STABILIZE or ALT_HOLD"
_CHECK_LINK = "check the link between computer and flight controller"
_WHERE = "a ground station sees this only over bridge.ground_connection"

VEHICLE: tuple[AlertSpec, ...] = (
    event(A.FC_FOUND, INFO, "flight controller found", {}, "the first heartbeat of the autopilot",
          "the MAVLink link works",
          _NONE),
    condition(A.FC_LOST, WARNING, "flight controller lost: no heartbeat 3 s", {},
              "no heartbeat for 3 s, after there were some", "a heartbeat is received (`fc_back`)",
              f"no fix is sent; {_WHERE}", f"{_BY_HAND}; {_CHECK_LINK}"),
    event(A.FC_BACK, INFO, "flight controller is back", {}, "a heartbeat after the loss",
          "the MAVLink link works again", _NONE),
    condition(A.FC_SILENT, WARNING, "no heartbeat from the flight controller", {},
              "sent once: no heartbeat in the first 5 s after the start; in health.json: no "
              "heartbeat for 3 s, also later in the flight", "a heartbeat is received",
              "no fix is sent", f"before take-off: {_CHECK_LINK}; in flight act as for `fc_lost`"),
    event(A.FC_REBOOTED, WARNING, "flight controller rebooted", {},
          "the boot time in its messages ran back",
          "the EKF has restarted with its first source set; fixes relative to its origin are sent "
          "when it is known again",
          "check the EKF source set"),
    condition(A.GNSS_LOST, WARNING, "GNSS lost, {output}", {"output": Output},
              "no 3D fix for 1 s, or no report for 2.5 s; a short recovery is ignored",
              "a 3D fix for 5 s, and no `gnss_refused`",
              "*injecting*: fixes are sent; *nothing is injected*: the EKF has no position",
              "without injection fly in STABILIZE or ALT_HOLD"),
    event(A.GNSS_BACK, INFO, "GNSS is back", {},
          "after `gnss_lost`: a 3D fix for 5 s, and no `gnss_refused`", "GNSS can be used again",
          "select the GNSS source set if you want it"),
    event(A.ARMED_WITHOUT_GNSS, WARNING, "armed without GNSS, {output}", {"output": Output},
          "the vehicle is armed without a 3D fix",
          "*injecting*: fixes are sent, but cannot be compared with GNSS; else the EKF has no "
          "position",
          "do not take off unless this is planned"),
    event(A.SENDER_IGNORED, WARNING, "MAVLink of {sender} ignored", {"sender": "name"},
          "UDP: MAVLink arrives from an address other than bridge.sender or, if that is not set, "
          "the first autopilot's; on bridge.ground_connection: other than the first ground "
          "station's",
          "messages from this address are ignored; if it is the autopilot's address, no fix is "
          "sent",
          "if it is the autopilot's address, set bridge.sender to it; else find this sender"),
    event(A.GIMBAL_IGNORED, WARNING, "gimbal {component}, device {device} ignored",
          {"component": "id", "device": "id"}, "a second gimbal reports its attitude",
          f"{_SENT}; only the angles of the first gimbal are used",
          "set bridge.camera.gimbal_component"),
    event(A.SECOND_COMPANION, WARNING, "another companion is component {component}",
          {"component": "id"}, "a heartbeat with this program's own ids is received",
          f"{_SENT}; another program uses the same ids and may send fixes too",
          "stop one of them"),
    event(A.DUPLICATE_SYSTEM_ID, WARNING, "two autopilots have system id {system}",
          {"system": "id"},
          "heartbeats of a second autopilot, or boot times that run back 40 times in 5 s",
          f"{_SENT}; the data of both autopilots are mixed", "change the system id of one"),
    event(A.AUTOPILOT_IGNORED, WARNING, "autopilot {system} ignored, using {used}",
          {"system": "id", "used": "id"}, "heartbeats of another autopilot",
          f"{_SENT}; its messages are ignored",
          "set bridge.system_id"),
    event(A.ARMING_ALTERNATES, WARNING, "system {system} armed, disarmed in turn", {"system": "id"},
          "heartbeats alternate between armed and disarmed three times in 10 s",
          f"{_SENT}; another sender may forge heartbeats",
          _SIGN),
    event(A.TIMESYNC_CONTRADICTS, WARNING, "TIMESYNC contradicts time stamps", {},
          "three answers in 10 s do not fit the timestamps of the autopilot",
          f"{_SENT}; two systems may answer", _SIGN),
    condition(A.TIMESYNC_UNANSWERED, WARNING, "TIMESYNC unanswered: stamps may drift", {},
              "after earlier answers: none for 15 s, although other messages are received",
              "an answer is received",
              f"{_SENT}; their times drift by up to 0.2 ms a second",
              "check the link",
              "TIMESYNC is answered again"),
    event(A.ORIGIN_REFUSED, WARNING, "EKF origin refused: {metres:.0f} m off", {"metres": "m"},
          "GPS_GLOBAL_ORIGIN changes while armed", f"{_SENT}, relative to the previous origin",
          _SIGN),
    event(A.ORIGIN_MOVED, INFO, "EKF origin moved; positions follow it", {},
          "GPS_GLOBAL_ORIGIN changes while disarmed", f"{_SENT}, relative to the new origin",
          _NONE),
    event(A.ORIGIN_KNOWN, INFO, "EKF origin known", {},
          "the first GPS_GLOBAL_ORIGIN after the start, a reboot or a lost link",
          "positions relative to the origin can be sent", _NONE),
    event(A.ORIGIN_DIFFERS, INFO, "EKF origin {metres:.0f} m from configured one", {"metres": "m"},
          "the first GPS_GLOBAL_ORIGIN is over 1 m from bridge.origin",
          f"{_SENT}, relative to the EKF's origin",
          "check bridge.origin"),
    condition(A.UNKNOWN_FIRMWARE, WARNING, "unknown firmware, using the safe profile", {},
              "AUTOPILOT_VERSION is not ArduPilot from 4.5 or PX4 from 1.15 on",
              "AUTOPILOT_VERSION names a known firmware",
              f"{_SENT}, with the settings of the most cautious firmware",
              "check that ArduPilot is 4.5 or newer, or PX4 1.15 or newer"),
    condition(A.MESSAGE_UNSUPPORTED, WARNING, "unsupported: {message}", {"message": "name"},
              "the firmware does not support bridge.injection.message",
              "AUTOPILOT_VERSION of a firmware that supports it",
              "the EKF receives no fix that it can use",
              "set another bridge.injection.message; " + _BY_HAND),
    event(A.SOURCE_SET_UNKNOWN, WARNING, "EKF source set not known: met in flight", {},
          "ArduPilot is already armed at its first heartbeat, for example after a crash of the "
          "program",
          "which source set the EKF uses is not known", "check the EKF source set"),
    event(A.SOURCE_SET_SELECTED, WARNING, "EKF source set {source_set}: {cause}",
          {"source_set": "", "cause": (GnssProblem, ReturnCause), "metres": "m"},
          "switch.enabled: the command is sent. To vision: GNSS was bad for 1.5 s, and fixes are "
          "sent. To GNSS, unless the pilot selected the vision set: with return_to_gnss, GNSS "
          "agrees with vision and IMU for 5 s; or no fix was sent for 3 s, and GNSS is good for "
          "3 s, within 25 m of the EKF's position, and not refused (`gnss_refused`)",
          "the EKF uses the sensors of this set, unless `source_set_refused` follows; *vision "
          "lost*: no fix is sent",
          "compare the position with landmarks"),
    event(A.SOURCE_SET_REFUSED, WARNING, "source switch refused", {},
          "the autopilot refuses to select the source set",
          "the EKF stays on its set; the command is repeated every second while its condition "
          "holds",
          "select the source set yourself"),
    condition(A.SOURCE_SET_HELD, WARNING, "no switch: {cause}, {why}",
              {"cause": GnssProblem, "metres": "m", "why": (SwitchRefusal, ChosenSet)},
              "switch.enabled: GNSS is bad for 1.5 s, but the vision set must not be selected; "
              "again every 10 s",
              "GNSS is good, or vision is selected",
              "the EKF stays on its source set; *not ready*: the shadow check has not "
              "passed, or an alert inhibits; *EKF with GNSS*: the EKF's position is nearer to "
              "GNSS than to vision; *set N chosen*: the pilot selected it",
              "decide by landmarks which source is right, and select it"),
    event(A.LOOK_AT_REFUSED, WARNING, "look-at refused: {why}", {"why": LookAtRefusal},
          "a command to point the gimbal cannot be carried out", "the gimbal does not move",
          "correct the command"),
    event(A.LOOK_AT_NO_TARGET, WARNING, "look-at refused: no target {number}", {"number": ""},
          "a command to point the gimbal at an unknown target", "the gimbal does not move",
          "give the number of an existing target"),
    event(A.LOOK_AT_UNANSWERED, WARNING, "autopilot does not answer look-at", {},
          "no answer to the gimbal command for 3 s", "the gimbal may not move",
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
          "a command of a system that is not allowed to send it",
          "the command is denied; reported once for each system",
          "if it is yours: add it to bridge.ground_systems, or sign its link"),
    event(A.SENDERS_REFUSED, WARNING, "system {system} and more refused: {why}",
          {"system": "id", "why": SenderRefusal},
          "a fourth system sends a command that it is not allowed to send; later ones are not "
          "reported",
          "their commands are denied",
          "if they are yours: add them to bridge.ground_systems, or sign their link"),
    event(A.HINT_TAKEN, NOTICE, "search {metres:.0f} m about the place given", {"metres": "m"},
          "the operator gives a position", "until the position is found, at most for 2 min, the "
          "map is searched within twice this radius", _NONE),
    event(A.HINT_REFUSED, WARNING, "hint refused: not on the map", {},
          "the operator gives a position farther from the map than twice the radius given with it",
          "the search continues without it",
          "give a position on the map"),
)  # fmt: skip
