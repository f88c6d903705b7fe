"""Click on a target as a ground station does, and read where it is: pymavlink, nothing of ours.

    python examples/click_to_target.py CONNECTION X Y [COUNT]

CONNECTION is pymavlink's, to the vehicle or to the companion's ground link (udpin:0.0.0.0:14550,
tcp:127.0.0.1:5763). X and Y are the point in the frame, 0 to 1 from its left and its top. Prints
COUNT (5) reports. MAVLink's camera protocol v2: https://mavlink.io/en/services/camera.html
"""

import os
import sys
import time
from typing import Any

os.environ["MAVLINK20"] = "1"  # the messages' numbers are above 255
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

CAMERA = mavlink.MAV_COMP_ID_CAMERA  # the component that tracks; an autopilot's own would refuse
TRIES, ANSWER_S = 20, 1.0


def hear(link: Any, kind: str, component: int = CAMERA) -> Any:
    """The next message of a kind from a component; None when none came in a second."""
    end = time.monotonic() + ANSWER_S
    while (left := end - time.monotonic()) > 0.0:
        message = link.recv_match(type=kind, blocking=True, timeout=left)
        if message is not None and message.get_srcComponent() == component:
            return message
    return None


def click(link: Any, x: float, y: float) -> None:
    """MAV_CMD_CAMERA_TRACK_POINT to the camera, again until it answers."""
    for _ in range(TRIES):
        # ArduPilot routes to a ground station once that has spoken.
        link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
        camera = hear(link, "HEARTBEAT")
        if camera is None:
            continue
        system = camera.get_srcSystem()
        track = mavlink.MAV_CMD_CAMERA_TRACK_POINT
        link.mav.command_long_send(system, CAMERA, track, 0, x, y, 0, 0, 0, 0, 0)
        answer = hear(link, "COMMAND_ACK")
        if answer is not None and answer.command == track:
            if answer.result != mavlink.MAV_RESULT_ACCEPTED:
                sys.exit(f"the camera refuses: MAV_RESULT {answer.result}")
            return
    sys.exit(f"no camera (component {CAMERA}) answers on this link")


def main(connection: str, x: float, y: float, count: int) -> None:
    """Click, then print the reports."""
    link = mavutil.mavlink_connection(connection, source_system=255, source_component=190)
    click(link, x, y)
    for _ in range(TRIES):
        target = hear(link, "CAMERA_TRACKING_GEO_STATUS")
        if target is None:
            continue
        print(
            f"{target.lat * 1e-7:.7f} {target.lon * 1e-7:.7f} {target.alt:.1f} m AMSL, "
            f"+-{target.h_acc:.1f} m, height +-{target.v_acc:.1f} m",
            flush=True,
        )
        count -= 1
        if count == 0:
            return
    sys.exit("no target: the companion says why in a text (STATUSTEXT) to the operator")


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5):
        sys.exit(__doc__)
    main(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int((*sys.argv, 5)[4]))
