"""Inject the fixes of your own localizer into ArduPilot, with `mavlink_bridge` alone.

    my_localizer | python examples/inject_my_fixes.py CONNECTION LAT LON ALTITUDE GEOID

CONNECTION is that of messages.md (serial:/dev/ttyTHS1:921600, udpin:0.0.0.0:14551, ...). LAT,
LON and ALTITUDE (metres above mean sea level) become the EKF's origin if it has none; GEOID is how
far the mean sea level lies above the ellipsoid there, metres. Your localizer, in any language,
writes a line per frame:

    {"time_ns": 81234567890, "latitude_deg": 47.39, "longitude_deg": 8.54, "height_m": 595.3,
     "quaternion": [0.707, 0, 0, 0.707], "sigma_m": 0.8}

(without the line break). The fields are those of `mavlink_bridge.VisionFix`; time_ns is the
exposure on this computer's CLOCK_MONOTONIC, the position is the vehicle's, its height above the
ellipsoid. quaternion (w, x, y, z) turns body axes to north, east, down; of a heading alone, give
that of a level body. Leave out what you do not know. Parameters of the autopilot: `companion
doctor`, and the table in docs/reference/messages.md. Fly it in mode "shadow" first: that compares
and sends nothing.
"""

import json
import sys

import numpy as np

from mavlink_bridge import Bridge, BridgeConfig, BridgeError, VisionFix
from mavlink_bridge.alerts.catalogue import text

DELAY_MS = 100.0  # a little over your localizer's latency, and the same in VISO_DELAY_MS


def fix_of(line: str) -> VisionFix:
    """A line of your localizer. sigma_m: its 1-sigma position error, the same in each direction."""
    fields = json.loads(line)
    covariance = np.eye(3) * float(fields.pop("sigma_m")) ** 2
    return VisionFix(**fields, position_covariance_ned=covariance)


def main(connection: str, latitude: str, longitude: str, altitude: str, geoid: str) -> None:
    """Hand over each line, until your localizer ends."""
    config = BridgeConfig.model_validate(
        {
            "connection": connection,
            "mode": "inject",
            "injection": {"message": "vision_position_estimate", "delay_ms": DELAY_MS},
            "origin": {
                "latitude_deg": latitude,
                "longitude_deg": longitude,
                "altitude_amsl_m": altitude,
            },
        }
    )
    # What the operator reads, on the ground station and here: "injecting", "not sent: ...", ...
    with Bridge(
        config, float(geoid), on_alert=lambda alert: print(text(alert), flush=True)
    ) as bridge:
        for line in sys.stdin:
            try:
                bridge.submit(fix_of(line))  # never blocks; the bridge has threads of its own
            except (BridgeError, ValueError, TypeError, KeyError) as error:
                print(f"not a fix: {line.strip()}: {error!r}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 6:
        sys.exit(__doc__)
    main(*sys.argv[1:])
