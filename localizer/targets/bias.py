"""Errors common to all targets of a flight: of map, pose and boresight.

They are a consider state (Schmidt): part of every target's covariance that no observation reduces,
so that many observations do not claim more than the map's accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array


@dataclass(frozen=True)
class SharedBias:
    """Sigmas of the common error: metres along each axis, and radians as seen from the camera."""

    sigma_m: float = 0.2
    sigma_rad: float = 0.0005

    def covariance(self, offset: Array) -> Array:
        """(3, 3) m², world axes, of a target at `offset` (3,) from the camera."""
        distance = float(np.linalg.norm(offset))
        d = offset / max(distance, 1e-6)
        across = np.eye(3) - np.outer(d, d)
        shared: Array = self.sigma_m**2 * np.eye(3) + (self.sigma_rad * distance) ** 2 * across
        return shared
