"""Errors that all targets of a flight share: of the map, the pose, and the boresight.

A state that no sighting measures (Schmidt's consider state): it is carried beside every target and
never shrinks, so that a hundred fixes of one place do not claim what the map cannot keep.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array


@dataclass(frozen=True)
class SharedBias:
    """One sigma of the bias: metres along each axis, and radians as seen from the camera."""

    sigma_m: float = 0.2
    sigma_rad: float = 0.0005

    def covariance(self, offset: Array) -> Array:
        """(3, 3) m², world axes, for a place at `offset` (3,) from the camera."""
        distance = float(np.linalg.norm(offset))
        d = offset / max(distance, 1e-6)
        across = np.eye(3) - np.outer(d, d)
        shared: Array = self.sigma_m**2 * np.eye(3) + (self.sigma_rad * distance) ** 2 * across
        return shared
