"""The values that a flight estimates, their prior sigmas and their useful accuracy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array


@dataclass(frozen=True)
class Unknown:
    """One estimated value. sigma: its weak prior; useful: accuracy from which the flight counts as
    informative. scale: from the value to the shown unit.
    """

    name: str
    unit: str
    sigma: float
    useful: float
    scale: float = 1.0


_DEGREES = float(np.degrees(1.0))
UNKNOWNS = (
    Unknown("focal length", "%", 0.1, 0.005, 100.0),
    Unknown("principal point right", "px", 20.0, 2.0),
    Unknown("principal point down", "px", 20.0, 2.0),
    Unknown("distortion k1", "", 0.1, 0.01),
    Unknown("distortion k2", "", 0.1, 0.02),
    Unknown("distortion p1", "", 0.01, 0.001),
    Unknown("distortion p2", "", 0.01, 0.001),
    Unknown("stamps late", "ms", 0.3, 0.02, 1000.0),
    Unknown("mounting about the boresight", "deg", 0.17, 0.005, _DEGREES),
    Unknown("mounting up", "deg", 0.17, 0.005, _DEGREES),
    Unknown("mounting right", "deg", 0.17, 0.005, _DEGREES),
    Unknown("autopilot's heading", "deg", 0.09, 0.01, _DEGREES),
    Unknown("camera forward", "m", 0.3, 0.1),
    Unknown("camera right", "m", 0.3, 0.1),
    Unknown("camera down", "m", 0.3, 0.1),
    Unknown("map east of GNSS", "m", 30.0, 0.3),
    Unknown("map north of GNSS", "m", 30.0, 0.3),
    Unknown("map above GNSS", "m", 30.0, 0.5),
    Unknown("autopilot's climb, scale", "%", 0.01, 0.002, 100.0),
)
COUNT = len(UNKNOWNS)
OPTICS = slice(0, 7)
FOCAL, CENTRE, BEND, LATE = 0, slice(1, 3), slice(3, 7), 7
MOUNT, HEADING, ARM, SHIFT, CLIMB = slice(8, 11), 11, slice(12, 15), slice(15, 18), 18
SIGMAS: Array = np.array([u.sigma for u in UNKNOWNS])
USEFUL: Array = np.array([u.useful for u in UNKNOWNS])
