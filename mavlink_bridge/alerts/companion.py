"""Alerts of the companion: localization, video, record, targets and the process itself."""

from __future__ import annotations

from mavlink_bridge.alerts.alert import AlertSpec, Kind, Severity, condition, event
from mavlink_bridge.alerts.ids import AlertId as A
from mavlink_bridge.alerts.words import ClickRefusal, Direction, MapOffsetUse, ProcessFault

CRITICAL, ERROR = Severity.CRITICAL, Severity.ERROR
WARNING, NOTICE, INFO = Severity.WARNING, Severity.NOTICE, Severity.INFO
_TAKE_OVER = "take over"
_VIDEO = f"{_TAKE_OVER}; check the camera and its link"
_SENT = "fixes continue"
_NO_FIX = "no fixes"
_LOAD = "take over; on the ground check the computer's load and temperature"
_RECORD = "check the disk after landing"
_SEARCH = "send the approximate position (console: *I am here*)"
_CLICK = "click again"
_RESOLUTION = "set the camera to the calibrated resolution"
_CONSOLE = "console: "
_NONE = "nothing"
_NUMBER: dict[str, Kind] = {"number": ""}
_NUMBER_WHY: dict[str, Kind] = {"number": "", "why": "name"}

HEALTH: tuple[AlertSpec, ...] = (
    condition(A.INITIALIZING, INFO, "localization initializing", {},
              "frames are processed, and the position is not confirmed yet",
              "three or more frames in a row are accepted, and the position is confirmed; or ten "
              "in a row are rejected (`lost`)",
              f"the position is not known yet; {_NO_FIX}", _TAKE_OVER),
    condition(A.TRACKING, INFO, "localization tracking", {}, "frames are accepted",
              "the status changes to `degraded`, `bridging` or `lost`",
              "fixes are made; they are sent if injection is on", _NONE),
    condition(A.DEGRADED, WARNING, "localization degraded", {},
              "three frames in a row are rejected, and odometry cannot bridge",
              "a frame is accepted, or the status changes to `bridging` or `lost`", _NO_FIX,
              "wait for `tracking` or `lost`"),
    condition(A.BRIDGING, WARNING, "bridging {seconds:.0f} s, {metres:.0f} m",
              {"seconds": "s", "metres": "m"},
              "no frame has matched the map for 2 s; odometry (the motion in the video) continues "
              "the position",
              "three frames in a row match the map, or odometry fails (`lost`)",
              f"{_SENT}, with a covariance that grows, until `hpl_over_limit`; N s: time since the "
              "last match; N m: 95 % bound of the position error",
              "fly back over mapped ground with buildings and roads"),
    condition(A.LOST, ERROR, "localization lost {seconds:.0f} s", {"seconds": "s"},
              "ten frames in a row are rejected; or one is, while the predicted position is too "
              "uncertain and odometry fails; or odometry fails during `bridging`",
              "a position is found and confirmed", f"{_NO_FIX}; N: time since the last fix",
              "take over"),
    condition(A.EKF_UNCERTAIN, WARNING, "autopilot position +-{metres:.0f} m", {"metres": "m"},
              "`lost`, and the autopilot has a position",
              "`lost` ends",
              f"{_NO_FIX}; N: 95 % bound of the error of the autopilot's position, estimated from "
              "the time since its last GNSS or vision fix",
              "take over; keep N to obstacles"),
    condition(A.NO_FRAME, WARNING, "no frame is being localized", {},
              "no frame was processed for 2 s, without an error",
              "a frame is processed", _NO_FIX, _VIDEO),
    condition(A.LOCALIZATION_FAILED, WARNING, "localization failed, see the log", {},
              "no frame was processed for 2 s, because of an error", "a frame is processed",
              _NO_FIX,
              f"{_TAKE_OVER}; land and read the log"),
    condition(A.OVERLOADED, WARNING, "overloaded, {done:.0f} of {offered:.0f} frames/s",
              {"done": "Hz", "offered": "Hz"},
              "over 5 s fewer than 3 frames/s are processed, and 6 or more received",
              "3 frames/s are processed", f"{_SENT}, but are too few for the EKF", _LOAD),
    condition(A.SEARCH_NOT_READY, WARNING, "search not ready", {},
              "the position is not known, and the search of the map is still being prepared",
              "it is prepared, or fails (`no_search`)",
              f"the position cannot be searched yet; {_NO_FIX}", _TAKE_OVER),
    condition(A.NO_SEARCH, WARNING, "no search", {}, "the search of the map could not be prepared",
              "the program is restarted",
              f"{_SENT} during `tracking`; a lost position will not be found",
              f"read the log; if the position is lost, {_SEARCH}"),
    condition(A.SEARCH_HANGS, WARNING, "the search hangs", {},
              "the search thread has made no progress for 2 min",
              "the search makes progress",
              f"{_SENT} during `tracking`; a lost position is not found", _SEARCH),
    condition(A.SEARCHING, INFO, "searching the map", {}, "no position is known since the start",
              "the first fix", f"the newest frame is compared with the map; {_NO_FIX}", _SEARCH),
    condition(A.MAP_LOADING, INFO, "map being loaded", {},
              "no frame was processed for 2 s, or none yet, because map tiles in view are being "
              "read",
              "a frame is processed", _NO_FIX, _TAKE_OVER),
    condition(A.WAITING_FOR_PRIOR, INFO, "waiting for a pose prior", {},
              "video is received, but no approximate position and attitude (pose prior)",
              "they are received", f"localization has not started; {_NO_FIX}", _SEARCH),
    condition(A.WAITING_FOR_VIDEO, INFO, "waiting for video", {}, "no frame was received yet",
              "a frame is received; or the video cannot be opened within 3 s (`video_stalled`)",
              f"localization has not started; {_NO_FIX}", _VIDEO),
    condition(A.VIDEO_FAILED, ERROR, "video feed failed", {},
              "the video cannot be opened or decoded", "frames are received", _NO_FIX, _VIDEO),
    condition(A.VIDEO_SIZE, ERROR, "video size does not fit the calibration", {},
              "the aspect ratio of the frames differs from that of `camera.model`",
              "the aspect ratio is right", f"the frames are not used; {_NO_FIX}",
              f"{_TAKE_OVER}; {_RESOLUTION}"),
    condition(A.VIDEO_STALLED, WARNING, "video feed stalled", {},
              "no frame was received for 1 s; or, at the start, the video cannot be opened within "
              "3 s",
              "a frame is received", _NO_FIX, _VIDEO),
    condition(A.VIDEO_SCALED, WARNING, "video scaled", {},
              "the frames have another size than `camera.model`, with the same aspect ratio",
              "the size is right",
              f"{_SENT}, with a scaled camera model; if the camera crops, they are wrong",
              _RESOLUTION),
    condition(A.MAP_UNREADABLE, WARNING, "map unreadable", {}, "map tiles cannot be read from disk",
              "every tile that failed has been read later",
              f"{_SENT}, but less accurate, because coarser tiles replace the missing ones",
              "check the disk after landing"),
    condition(A.RECORD_INCOMPLETE, WARNING, "record incomplete", {},
              "a write to the record failed, or its disk was missing at a restart",
              "the program is restarted",
              "recording goes on if the disk allows it", _RECORD),
    event(A.ENDING, NOTICE, "ending, nothing is injected any more", {},
          "the program was stopped, or its video ended; not a crash", _NO_FIX, _TAKE_OVER),
    event(A.COMPANION_RESTARTS, CRITICAL, "companion {how} ({what}), restarting",
          {"how": ProcessFault, "what": "name"}, "with `companion run --supervised`: the flight "
          "process crashed, was killed, or hangs (a thread for 4 s, the process for 3 s)",
          f"the supervisor starts it again at once; {_NO_FIX} for some seconds; HOW: *died* or "
          "*hangs*; WHAT: thread or signal", _TAKE_OVER),
    event(A.COMPANION_WAITS, CRITICAL, "companion {how} ({what}), again in {seconds:.0f} s",
          {"how": ProcessFault, "what": "name", "seconds": "s"},
          "with `companion run --supervised`: the flight process crashed, was killed or hung for "
          "the fifth time in 5 min, and no standby process is ready",
          f"the supervisor starts it again after N (2 to 30 s); {_NO_FIX} until then", _TAKE_OVER),
    event(A.DEPLOYMENT_LOST, WARNING, "deployment file lost, flown as before", {},
          "at a restart after a crash the deployment file is invalid or cannot be read",
          f"{_SENT}, with the settings from before the crash",
          "after landing read the reason in events.csv; check file and disk"),
    event(A.VIDEO_SENDER_IGNORED, WARNING, "video of {host} ignored", {"host": "name"},
          "on UDP, video arrives from an address other than `camera.settings.sender` (if that is "
          "not set: than the first sender's)",
          "this video is ignored; if it is the only one, no fixes",
          "if it is your camera's address, set `camera.settings.sender` to it"),
    condition(A.ZOOM_UNKNOWN, WARNING, "zoom unknown, no fixes: no CAMERA_SETTINGS", {},
              "no CAMERA_SETTINGS in the 2 s before a frame; again every 10 s",
              "CAMERA_SETTINGS is received",
              f"the focal length is unknown; {_NO_FIX}",
              f"{_TAKE_OVER}; check the camera's MAVLink connection"),
    condition(A.ZOOM_NOT_IN_TABLE, WARNING, "zoom {level:.0f} not in table, no fixes",
              {"level": "%"}, "the zoom level N (0 to 100 %) is outside the table "
              "`camera.zoom.points`; again every 10 s",
              "the level is inside the table", f"the focal length is unknown; {_NO_FIX}",
              f"set a zoom level inside the table; {_TAKE_OVER}"),
    event(A.MAP_OFFSET, NOTICE, "map {metres:.1f} m {direction} of GNSS{applied}",
          {"metres": "m", "direction": Direction, "applied": MapOffsetUse},
          "vision and GNSS have differed by a constant offset of at most 15 m for a minute or "
          "more; again if it changes by 2 m",
          "the map or GNSS has this offset; *applied* (`bridge.injection.map_shift`): it is "
          "subtracted from the fixes",
          "check the map's georeference after landing"),
    event(A.DETECTOR_OFF, WARNING, "the detector is off, see the log", {},
          "the detection model cannot be loaded, or fails in three frames in a row",
          "no targets are detected until a restart", "click targets by hand"),
)  # fmt: skip
TARGETS: tuple[AlertSpec, ...] = (
    event(A.TARGET_FOUND, INFO, "target {number}: +-{metres:.1f} m", {"number": "", "metres": "m"},
          "the position of a click is found",
          "a target is made; N: horizontal sigma of its position (both axes)", _NONE),
    event(A.TARGET_REFUSED, WARNING, "target {number} refused: {why}", _NUMBER_WHY,
          "the position of a click cannot be found", "no target is made", _CLICK),
    event(A.TARGET_UNREADABLE, WARNING, "target {number} refused: map unreadable?", _NUMBER,
          "an error while the position of a click is computed", "no target is made",
          "click again; after landing read the first such error in the log"),
    event(A.NO_TARGET, WARNING, "no target: {why}", {"why": ClickRefusal},
          "within 2 s the position at the clicked frame is not known (*position not known*), or "
          "the status there is not `tracking` (*position not confirmed yet*)",
          "no target is made",
          "wait for `tracking`, then click again"),
    event(A.TARGET_OUT_OF_VIEW, INFO, "target {number} ended: out of view", _NUMBER,
          "a clicked target is outside the frame for 300 s", "the target is deleted", _CLICK),
    event(A.TARGET_REPLACED, INFO, "target {number} ended: too many", _NUMBER,
          "a ninth target is clicked", "the oldest target is deleted", _NONE),
    event(A.TARGET_LOST, INFO, "target {number} lost", _NUMBER,
          "a moving target is not seen for 4 s", "the target is deleted", _CLICK),
    event(A.TARGET_NOT_LOCATED, INFO, "target {number} lost: {why}", _NUMBER_WHY,
          "the position of a moving target cannot be computed for 4 s", "the target is deleted",
          _CLICK),
    event(A.TARGET_LEFT, WARNING, "target {number} lost: it left its place", _NUMBER,
          "a target that moved when it was clicked is not seen for 1.2 s, and the image shows the "
          "ground in its place",
          "the target is deleted", _CLICK),
    condition(A.TARGET_MAY_HAVE_LEFT, WARNING, "target {number} may have left: look changed",
              _NUMBER, "the target is not seen for 3 s, after a sudden change of its image",
              "it looks as before, or the target ends",
              "the target may have moved; its last position is still reported, as hidden "
              "(not seen), with a sigma that grows",
              "look at the video, and click again"),
    condition(A.TARGET_HELD, INFO, "target {number}: kept, its look has changed", _NUMBER,
              "the target is not seen for 3 s, after a slow change of its image",
              "it looks as before, or the target ends", "its position is kept and reported", _NONE),
    event(A.TARGET_BACK, INFO, "target {number} is at its place again", _NUMBER,
          "the image at the target looks as before", "the target has not moved", _NONE),
    condition(A.TARGET_SILENT, WARNING, "{name} not reported: {why}",
              {"name": "name", "why": "name"},
              "the position of a detected target that was reported is rejected for 2 s; at most "
              "one such text in 10 s",
              "its position is accepted", "the target is neither sent nor shown", _NONE),
)  # fmt: skip
CONSOLE: tuple[AlertSpec, ...] = (
    event(A.CONSOLE_STOP, NOTICE, "targets ended", {},
          "the operator ends the targets in the console",
          "all targets that were clicked, in the console or at a ground station, are deleted; "
          "targets of the detector stay", "if this was a mistake, click again", lead=_CONSOLE),
    event(A.CONSOLE_TARGET, NOTICE, "target at {x:.2f} {y:.2f}", {"x": "", "y": ""},
          "the operator clicks a point in the console's video",
          "a target is requested at this share of width and height; `target_found` or a refusal "
          "follows", _NONE,
          lead=_CONSOLE),
    event(A.CONSOLE_BOX, NOTICE, "target box at {x:.2f} {y:.2f}", {"x": "", "y": ""},
          "the operator draws a box in the console's video",
          "a target is requested in a box with this top left corner (shares of width and height); "
          "`target_found` or a refusal follows", _NONE,
          lead=_CONSOLE),
    event(A.CONSOLE_HINT, NOTICE, "hint {latitude:.4f} {longitude:.4f} +-{metres:.0f} m",
          {"latitude": "deg", "longitude": "deg", "metres": "m"},
          "the operator sends *I am here* in the console",
          "searches of the next 2 min look within N m of this position; it is never sent as a fix",
          _NONE, lead=_CONSOLE),
)  # fmt: skip
