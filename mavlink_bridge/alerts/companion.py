"""Alerts of the companion: localization, video, record, targets and the process itself."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import NOTHING, WHILE, AlertSpec, Kind, Severity, condition, event
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import ClickRefusal, Direction, MapOffsetUse, ProcessFault

CRITICAL, ERROR = Severity.CRITICAL, Severity.ERROR
WARNING, NOTICE, INFO = Severity.WARNING, Severity.NOTICE, Severity.INFO
_TAKE_OVER = "take over"
_VIDEO = f"{_TAKE_OVER}; check the camera and its link"
_NO_FIX = "no fixes"
_HANG = "a thread of the localization hangs"
_REPLACED = "with `--supervised` the process is replaced after 4 s"
_DISK = "check the disk"
_CLICK = "click again"
_ONLY_NEAR = "a lost position is found again only near the autopilot's own position (GNSS)"
_RESOLUTION = "set the camera to the calibrated resolution"
_CONSOLE = "console: "
_GONE, _NO_TARGET = "the target is deleted", "no target is made"
_NUMBER: dict[str, Kind] = {"number": ""}
_NUMBER_WHY: dict[str, Kind] = {"number": "", "why": "name"}

HEALTH: tuple[AlertSpec, ...] = (
    condition(A.INITIALIZING, INFO, "localization initializing", {},
              "frames are processed, but the first position is not confirmed",
              "three or more frames in a row are accepted and confirm it; or ten in a row are "
              "rejected (`lost`)",
              _NO_FIX, _TAKE_OVER),
    condition(A.TRACKING, INFO, "localization tracking", {}, "frames are accepted",
              "another localization status, such as `bridging`",
              "fixes are made; with injection they are sent, unless an alert says otherwise",
              NOTHING),
    condition(A.DEGRADED, WARNING, "localization degraded", {},
              "three frames in a row are rejected, and odometry fails",
              "a frame is accepted, odometry works (`bridging`), or ten frames in a row are "
              "rejected (`lost`)", _NO_FIX,
              "wait for `tracking` or `lost`"),
    condition(A.BRIDGING, WARNING, "bridging {seconds:.0f} s, {metres:.0f} m",
              {"seconds": "s", "metres": "m"},
              "no frame was accepted for 2 s; odometry continues the position",
              "three frames in a row are accepted, or odometry fails (`lost`)",
              "fixes are sent, but get less accurate, until `hpl_over_limit`; N s: since the last "
              "accepted frame; N m: 95 % bound of the error",
              "fly back over mapped ground with buildings and roads"),
    condition(A.LOST, ERROR, "localization lost {seconds:.0f} s", {"seconds": "s"},
              "odometry fails during `bridging`, or while ten frames in a row are rejected or the "
              "predicted position is too uncertain",
              "a search of the map finds a position, and frames and motion confirm it",
              f"{_NO_FIX}; N: time since the map last confirmed the position (0: never)",
              _TAKE_OVER),
    condition(A.EKF_UNCERTAIN, WARNING, "autopilot position +-{metres:.0f} m", {"metres": "m"},
              "`lost` is active, and the autopilot has a position", WHILE,
              "N: 95 % bound of its error when the text is sent; it grows with the time since its "
              "last GNSS or vision fix",
              f"{_TAKE_OVER}; keep N to obstacles"),
    condition(A.NO_FRAME, WARNING, "no frame is being localized", {},
              "frames are received, but for 2 s none was processed, without an error (not during "
              "`lost`)", WHILE,
              f"{_NO_FIX}; {_HANG}, unless `zoom_unknown` or `zoom_not_in_table` is active; "
              f"{_REPLACED}",
              f"{_TAKE_OVER}; after landing read the log"),
    condition(A.LOCALIZATION_FAILED, WARNING, "localization failed, see the log", {},
              "no frame was processed for 2 s, or none yet, with an error other than "
              "`no_map_in_view`", WHILE, _NO_FIX, f"{_TAKE_OVER}; land and read the log"),
    condition(A.OVERLOADED, WARNING, "overloaded, {done:.0f} of {offered:.0f} frames/s",
              {"done": "Hz", "offered": "Hz"},
              "over 5 s fewer than 3 frames/s (the first N) are processed, and 6 or more (the "
              "second) received", WHILE,
              "there are too few fixes for the EKF",
              f"{_TAKE_OVER}; check the computer's load and temperature"),
    condition(A.SEARCH_NOT_READY, WARNING, "search not ready", {},
              "the position is not known (at the start or `lost`), and the map search is being "
              "prepared", WHILE,
              f"{_NO_FIX} for seconds; without the map's overview (`companion map build "
              "--overview`) 7 s per km²", _TAKE_OVER),
    condition(A.NO_SEARCH, WARNING, "no map search possible, see the log", {},
              "the map search could not be prepared", "a restart",
              f"{_ONLY_NEAR}; fixes go on while frames are accepted",
              "on the ground read the log and restart; in flight stay where vision works"),
    condition(A.SEARCH_HANGS, WARNING, "the search hangs", {},
              "a search has made no progress for 2 min",
              "it goes on; usually only a restart",
              f"{_ONLY_NEAR}; the alert stays when it is found, and fixes go on then",
              f"{_TAKE_OVER}; on the ground restart the program"),
    condition(A.SEARCHING, INFO, "searching the map", {},
              "no position is known since the start, and the map is searched for one",
              "the first frame is processed", _NO_FIX, "give the position"),
    condition(A.NO_MAP_IN_VIEW, NOTICE, "no map in view", {},
              "no frame was processed for 2 s, or none yet: map tiles are being read, or the "
              "camera is too near the ground (take-off) or looks past the map", WHILE, _NO_FIX,
              "in flight take over; check the camera's mount and the map's extent"),
    condition(A.WAITING_FOR_PRIOR, INFO, "waiting for attitude and height", {},
              "no position is known, and the autopilot's attitude or altitude or the gimbal's "
              "angles are missing", WHILE, f"{_NO_FIX}; the map cannot be searched",
              f"{_TAKE_OVER}; check ATTITUDE, GLOBAL_POSITION_INT and the gimbal's messages"),
    condition(A.WAITING_FOR_VIDEO, INFO, "waiting for video", {}, "no frame was received yet",
              "a frame is received, or after 3 s (`video_stalled`)", _NO_FIX, _VIDEO),
    condition(A.VIDEO_FAILED, ERROR, "video feed failed", {},
              "a file is damaged, or the first frames' aspect ratio or pixels cannot be used",
              "the program ends at once (`ending`); with `--supervised` it is restarted, except "
              "in its first seconds", _NO_FIX,
              f"{_TAKE_OVER}; read the log, check the camera's settings"),
    condition(A.VIDEO_SIZE, ERROR, "video size does not fit the calibration", {},
              "frames change to another aspect ratio than `camera.model`, or to other pixels",
              WHILE,
              f"they are not used; {_NO_FIX}", f"{_TAKE_OVER}; {_RESOLUTION}"),
    condition(A.VIDEO_STALLED, WARNING, "video feed stalled", {},
              "no frame was received, or could be decoded, for 1 s (at the start 3 s)", WHILE,
              f"{_NO_FIX}; the program connects again by itself", _VIDEO),
    condition(A.VIDEO_SCALED, WARNING, "video scaled", {},
              "frames have another size than `camera.model`, with the same aspect ratio; its "
              "end is not sent", WHILE,
              "the camera model is scaled; fixes are wrong if the camera crops", _RESOLUTION),
    condition(A.MAP_UNREADABLE, WARNING, "map unreadable", {}, "map tiles cannot be read from disk",
              "all of them have been read; no text",
              "coarser tiles replace them: fixes are less accurate, or none", _DISK),
    condition(A.RECORD_INCOMPLETE, WARNING, "record incomplete", {},
              "a write to the record failed, or its disk was full, failing or missing at the start",
              "a restart",
              "recording goes on if the disk allows it; fixes are not affected", _DISK),
    event(A.ENDING, NOTICE, "ending, nothing is injected any more", {},
          "the program was stopped, or its video ended or failed", _NO_FIX, _TAKE_OVER),
    event(A.COMPANION_RESTARTS, CRITICAL, "companion {how} ({what}), restarting",
          {"how": ProcessFault, "what": "name"}, "with `--supervised`: the flight process crashed "
          "or was killed (*died*; WHAT: signal or exit code), or a thread did not run for 4 s, the "
          "process for 3 s (*hangs*; WHAT: thread)",
          f"it restarts at once; {_NO_FIX} for 2 to 10 s; then injection starts as after a start "
          "(mode rc: is on as before)", _TAKE_OVER),
    event(A.COMPANION_WAITS, CRITICAL, "companion {how} ({what}), again in {seconds:.0f} s",
          {"how": ProcessFault, "what": "name", "seconds": "s"},
          "as `companion_restarts` (HOW, WHAT), but five times in 5 min, and no standby is ready",
          f"it restarts after N (2 to 30 s); {_NO_FIX} for about 10 s more", _TAKE_OVER),
    event(A.DEPLOYMENT_LOST, WARNING, "deployment file lost, flown as before", {},
          "at a restart after a crash the deployment file cannot be read or used",
          "the settings of the first start are used",
          "after landing read events.csv; check file and disk"),
    event(A.VIDEO_SENDER_IGNORED, WARNING, "video of {host} ignored", {"host": "name"},
          "UDP: video arrives from another address than `camera.settings.sender` or, if not set, "
          "the first sender; each once", f"it is ignored; if it is the only one, {_NO_FIX}",
          "set `camera.settings.sender` to your camera's address"),
    condition(A.ZOOM_UNKNOWN, WARNING, "zoom unknown, no fixes: no CAMERA_SETTINGS", {},
              "CAMERA_SETTINGS is missing in the 2 s before a frame; again every 10 s", WHILE,
              f"the focal length is unknown; {_NO_FIX}",
              f"{_TAKE_OVER}; check the camera's MAVLink connection"),
    condition(A.ZOOM_NOT_IN_TABLE, WARNING, "zoom {level:.0f} not in table, no fixes",
              {"level": "%"}, "the zoom level N (0 to 100 %) is outside `camera.zoom.points`; "
              "again every 10 s", WHILE, f"the focal length is unknown; {_NO_FIX}",
              f"set a zoom level inside the table; {_TAKE_OVER}"),
    event(A.MAP_OFFSET, NOTICE, "map {metres:.1f} m {direction} of GNSS{applied}",
          {"metres": "m", "direction": Direction, "applied": MapOffsetUse},
          "the EKF uses GNSS, and for a minute or more vision differed from it by N, over 3.4 "
          "times the receiver's accuracy (0.5 m at least; 2.5 m if unknown) and 15 m at most; "
          "again if N changes by 2 m; not with message gps_input; PX4, external_position_estimate: "
          "not while fixes are sent",
          "map or GNSS is off; *applied* (`bridge.injection.map_shift`): N is subtracted from the "
          "fixes, also after the loss of GNSS; otherwise fixes keep it",
          "check the map's georeference after landing"),
    event(A.DETECTOR_OFF, WARNING, "the detector is off, see the log", {},
          "the detection model cannot be loaded, or fails in three frames in a row",
          "no targets are detected until a restart", "click targets by hand"),
)  # fmt: skip
TARGETS: tuple[AlertSpec, ...] = (
    event(A.TARGET_FOUND, INFO, "target {number}: +-{metres:.1f} m", {"number": "", "metres": "m"},
          "a click's position is found",
          "a target is made; N: its horizontal sigma, east and north combined", NOTHING),
    event(A.TARGET_REFUSED, WARNING, "target {number} refused: {why}", _NUMBER_WHY,
          "a click's position cannot be found (WHY, such as no map there, over 5 km away, or known "
          "to over 50 m only)", _NO_TARGET, _CLICK),
    event(A.TARGET_UNREADABLE, WARNING, "target {number} refused: map unreadable?", _NUMBER,
          "an error while a click's position is computed", _NO_TARGET,
          f"{_CLICK}; after landing read the log"),
    event(A.NO_TARGET, WARNING, "no target: {why}", {"why": ClickRefusal},
          "the clicked frame has no position within 2 s (*not known*), or its status is not "
          "`tracking` (*not confirmed yet*)",
          _NO_TARGET, "wait for `tracking`, then click again"),
    event(A.TARGET_OUT_OF_VIEW, INFO, "target {number} ended: out of view", _NUMBER,
          "a clicked target is outside the frame for 300 s", _GONE, _CLICK),
    event(A.TARGET_REPLACED, INFO, "target {number} ended: too many", _NUMBER,
          "a ninth target is clicked", "the oldest, NUMBER, is deleted", NOTHING),
    event(A.TARGET_LOST, INFO, "target {number} lost", _NUMBER,
          "a clicked target that moves is not seen for 4 s", _GONE, _CLICK),
    event(A.TARGET_NOT_LOCATED, INFO, "target {number} lost: {why}", _NUMBER_WHY,
          "a clicked target that moves is seen, but for 4 s its position cannot be computed (WHY)",
          _GONE, _CLICK),
    event(A.TARGET_LEFT, WARNING, "target {number} lost: it left its place", _NUMBER,
          "a target that moved when clicked is not seen for 1.2 s, and the image shows the ground "
          "in its place", _GONE, _CLICK),
    condition(A.TARGET_MAY_HAVE_LEFT, WARNING, "target {number} may have left: look changed",
              _NUMBER,
              "a clicked target that stands is in view, but for 3 s not recognized, after a "
              "sudden change of its image",
              "`target_back`, or the target ends",
              "its last position is reported as hidden, with growing sigma",
              "look at the video, and click again"),
    condition(A.TARGET_HELD, INFO, "target {number}: kept, its look has changed", _NUMBER,
              "a clicked target that stands is in view, but for 3 s not recognized, after a slow "
              "change of its image; once each",
              "it looks as before (no text), or the target ends",
              "its position is kept and reported",
              NOTHING),
    event(A.TARGET_BACK, INFO, "target {number} is at its place again", _NUMBER,
          "after `target_may_have_left` it looks as before", "the target has not moved", NOTHING),
    condition(A.TARGET_SILENT, WARNING, "{name} not reported: {why}",
              {"name": "name", "why": "name"},
              "for 2 s the position of a target of the detector, reported before, is rejected "
              "(WHY); one text in 10 s at most; its end is not sent", WHILE,
              "the target is neither sent nor shown", NOTHING),
)  # fmt: skip
CONSOLE: tuple[AlertSpec, ...] = (
    event(A.CONSOLE_STOP, NOTICE, "targets ended", {},
          "the operator ends the targets in the console",
          "all clicked targets, also a ground station's, are deleted; the detector's stay",
          "if by mistake, click again", lead=_CONSOLE),
    event(A.CONSOLE_TARGET, NOTICE, "target at {x:.2f} {y:.2f}", {"x": "", "y": ""},
          "the operator clicks into the console's video",
          "a target is requested at these shares of width and height; `target_found` or a refusal "
          "follows", NOTHING, lead=_CONSOLE),
    event(A.CONSOLE_BOX, NOTICE, "target box at {x:.2f} {y:.2f}", {"x": "", "y": ""},
          "the operator draws a box in the console's video",
          "a target is requested; X Y: the box's top left corner, as shares of width and height",
          NOTHING, lead=_CONSOLE),
    event(A.CONSOLE_HINT, NOTICE, "hint {latitude:.4f} {longitude:.4f} +-{metres:.0f} m",
          {"latitude": "deg", "longitude": "deg", "metres": "m"},
          "the operator gives the position in the console",
          "N N: latitude, longitude; searches of the next 2 min look within +-N m", NOTHING,
          lead=_CONSOLE),
)  # fmt: skip
