"""Visual odometry: frame to keyframe, where the map does not match (odometry.md)."""

from localizer.odometry.config import GrowthModel, OdometryConfig
from localizer.odometry.estimate import OdometryEstimate, OdometryFrame, OdometryStatus
from localizer.odometry.ground import FlatGround, GroundUncertainty, TerrainModel
from localizer.odometry.keyframe import DepthSource
from localizer.odometry.odometry import VisualOdometry, odometry_optimizer
from localizer.odometry.usability import ImageFault, Usability, examine

__all__ = [
    "DepthSource",
    "FlatGround",
    "GroundUncertainty",
    "GrowthModel",
    "ImageFault",
    "OdometryConfig",
    "OdometryEstimate",
    "OdometryFrame",
    "OdometryStatus",
    "TerrainModel",
    "Usability",
    "VisualOdometry",
    "examine",
    "odometry_optimizer",
]
