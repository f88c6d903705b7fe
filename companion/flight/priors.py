"""Where the camera is by other means than the map, for a start and for the search after a loss."""

from __future__ import annotations

import numpy as np

from companion.config import PriorConfig
from companion.flight.conversions import Installation, camera_rotation, vehicle_prior
from localizer.geometry.pose import Array
from localizer.tracking.engine import PriorProvider
from localizer.types import PosePrior
from mavlink_bridge.bridge import Bridge


class AutopilotPose:
    """The camera's pose as the autopilot's position, attitude and gimbal tell it."""

    def __init__(self, bridge: Bridge, installation: Installation, config: PriorConfig) -> None:
        self._bridge = bridge
        self._installation = installation
        self._sigma = config.position_sigma_m, float(np.radians(config.rotation_sigma_deg))

    def prior(self, time_ns: int) -> PosePrior | None:
        """The camera's pose at a CLOCK_MONOTONIC time; None while the autopilot does not know."""
        return vehicle_prior(
            self._bridge.state(),
            self._bridge.attitude_at(time_ns),
            self._bridge.gimbal_at(time_ns),
            self._installation,
            self._sigma,
            time_ns,
        )

    def rotation(self, time_ns: int) -> Array | None:
        """The camera's rotation (3, 3) in the map's axes by the autopilot's attitude and gimbal."""
        gimbal = self._bridge.gimbal_at(time_ns)
        return camera_rotation(gimbal) if gimbal is not None else None


class PriorSources:
    """Whoever may know where the camera is, asked in order; the first answer counts."""

    def __init__(self, *sources: PriorProvider) -> None:
        self._sources = sources

    def add(self, source: PriorProvider) -> None:
        """Have `source` asked, too, where those that are there already know nothing."""
        self._sources = (*self._sources, source)

    def at(self, time_ns: int) -> PosePrior | None:
        """A prior for that CLOCK_MONOTONIC time; None if nobody knows."""
        for source in self._sources:
            prior = source(time_ns)
            if prior is not None:
                return prior
        return None
