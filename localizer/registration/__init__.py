"""Registration: geo-anchors, pose hypotheses and the JNGO optimizer (registration.md)."""

from localizer.registration.anchors import anchors_at, select_anchors
from localizer.registration.config import JNGOConfig
from localizer.registration.jngo import JNGO
from localizer.registration.priors import (
    PoseConstraint,
    attitude_constraint,
    combine,
    height_constraint,
    position_constraint,
)
from localizer.registration.result import Registration

__all__ = [
    "JNGO",
    "JNGOConfig",
    "PoseConstraint",
    "Registration",
    "anchors_at",
    "attitude_constraint",
    "combine",
    "height_constraint",
    "position_constraint",
    "select_anchors",
]
