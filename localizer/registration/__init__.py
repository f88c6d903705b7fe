"""Registration: geo-anchors, pose hypotheses and the JNGO optimizer (docs/registration.md)."""

from localizer.registration.anchors import select_anchors
from localizer.registration.backend import QuadraticPrior
from localizer.registration.jngo import JNGO, JNGOConfig, Registration

__all__ = ["JNGO", "JNGOConfig", "QuadraticPrior", "Registration", "select_anchors"]
