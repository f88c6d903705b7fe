"""Constants of the odometry: change of the keyframe, limits of results, growth of errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array
from localizer.sensors.error_model import SENSORS


@dataclass(frozen=True)
class GrowthModel:
    """Growth of the error with distance, beyond each registration's covariance.

    Fitted by ``python -m benchmarks.odometry`` (odometry.md). A random walk is a sigma per square
    root of a metre flown, from keyframe to keyframe; scale is a constant relative error.
    """

    scale: float  # scale sigma over ground of known height, as a share of the distance
    horizontal: float  # walk of east and north, m per root m
    vertical: float  # walk of the height, m per root m
    tilt: float  # walk of roll and pitch, rad per root m
    heading: float  # walk of the heading, rad per root m
    registration: float = 1.0  # variance factor of each registration's covariance
    # Height, tilt and the map's shape correct the pose's other axes, and the part of the position
    # that is correlated with them. Nothing corrects the rest of the position: without this walk,
    # a night of quality 0.65 was 12.8 m off with a sigma of 1.8 m, and 39 of 100 frames were inside
    # their 95 % bound.
    unmatched: float = 0.0  # uncorrected walk of east and north, m per root m, times (1 - quality)


@dataclass(frozen=True)
class OdometryConfig:
    """Limits for keyframes and registrations, and error growth."""

    anchors: int = 3000  # anchors per keyframe
    min_overlap: float = 0.35  # share of a keyframe's anchors in view of a usable frame
    max_sigma_m: float = 2.0  # position sigma of a usable registration
    min_log_odds: float = 1.0  # of image and prediction together
    new_below_overlap: float = 0.7  # overlap below which a new keyframe starts
    new_below_quality: float = 0.6  # quality, as a share of the keyframe's first, likewise
    new_beyond_turn_deg: float = 25.0  # turn since the keyframe that starts a new one
    longest_gap_s: float = 3.0  # time without a usable frame until it is lost
    longest_sigma_m: float = 15.0  # largest sigma of a propagated position with a map in view
    off_map_sigma_m: float = 100.0  # the same where there is no map to be found again
    acceleration_sigma: float = 2.0  # m/s², of the motion without usable frames
    turn_sigma_deg: float = SENSORS.tilt_change_deg  # autopilot's tilt since the keyframe, per axis
    heading_turn_sigma_deg: float = SENSORS.heading_change_deg  # its heading since the keyframe
    rise_sigma_m: float = SENSORS.climb_m  # barometer's climb since the keyframe
    parallax_noise: float | None = 0.02  # sigma of a parallax cost, as a share; None: not used
    # growth with depth from the map
    with_map: GrowthModel = GrowthModel(
        registration=1.0,
        scale=0.001,
        horizontal=0.02,
        vertical=0.02,
        tilt=5e-4,
        heading=4e-4,
        unmatched=0.3,
    )
    # growth with depth from a terrain model
    with_ground: GrowthModel = GrowthModel(
        registration=49.0, scale=0.005, horizontal=0.04, vertical=0.03, tilt=2e-4, heading=1e-3
    )
    # growth with a rangefinder
    with_range: GrowthModel = GrowthModel(
        registration=49.0, scale=0.045, horizontal=0.04, vertical=0.03, tilt=2e-4, heading=1e-3
    )
    # growth over ground taken as level: as over that of a rangefinder, and `GroundUncertainty`
    with_plane: GrowthModel = GrowthModel(
        registration=49.0, scale=0.045, horizontal=0.04, vertical=0.03, tilt=2e-4, heading=1e-3
    )

    @property
    def turn_sigma(self) -> Array:
        """Sigmas (3,) of the autopilot's turn since the keyframe, rad, world axes."""
        tilt, heading = self.turn_sigma_deg, self.heading_turn_sigma_deg
        return np.radians([tilt, tilt, heading])
