"""Detects that the propagated pose is wrong although the map's registrations fail the acceptance
test.

Odometry keeps the error of its start. If it starts a few metres off, it keeps that error with a
small covariance, and every right registration is rejected. So rejected registrations are followed
in parallel. If they move as the odometry does (whose motion is independent of the map) over a
distance on which a wrong match would have changed, the propagated pose is given up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from localizer.geometry.pose import Array, Pose
from localizer.integrity.acceptance import IntegrityConfig
from localizer.integrity.confirmation import (
    Consistency,
    IndependentEvidence,
    TentativeTrack,
    consistency_test,
)

_LEAST_RUN = 8  # registrations in a row
_DRIFT_SIGMA_M = 0.2  # of the odometry over such a way


@dataclass(frozen=True)
class Rejoining:
    """Rejected registrations compared with the propagated pose; immutable, `with_registration`
    gives the next state.

    begun: the first registration of the series; carried: the odometry's position (3,) at its time.
    registrations: length of the series. confirmed: whether the series refutes the propagated pose.
    """

    begun: TentativeTrack | None = None
    carried: Array | None = None
    registrations: int = 0
    confirmed: bool = False

    def with_registration(
        self, pose: Pose, covariance: Array, time_ns: int, carried: Pose, rotation: Array | None,
        config: IntegrityConfig,
    ) -> Rejoining:  # fmt: skip
        """Add a rejected registration of good quality, covariance (6, 6), exposure time_ns; returns
        the next state. carried: the propagated pose at this time. rotation: (3, 3)
        world_from_camera by the autopilot; None: unknown. A registration that contradicts the
        series starts a new one.
        """
        first = Rejoining(TentativeTrack(pose, covariance, time_ns), carried.translation, 1)
        if self.begun is None or self.carried is None:
            return first
        way = (carried.translation - self.carried, _DRIFT_SIGMA_M)
        verdict = consistency_test(
            self.begun, pose, covariance, time_ns, IndependentEvidence(rotation, way), config
        )
        if verdict is Consistency.CONTRADICTED or self._jumps(pose, way[0], covariance):
            return first
        registrations = self.registrations + 1
        confirmed = verdict is Consistency.CONFIRMED and registrations >= _LEAST_RUN
        return replace(self, registrations=registrations, confirmed=self.confirmed or confirmed)

    def _jumps(self, pose: Pose, way: Array, covariance: Array) -> bool:
        """Whether this registration deviates from the series by more than the noise."""
        if self.begun is None:
            return False
        moved = pose.translation - self.begun.world_from_camera.translation
        own = float(np.sqrt((self.begun.covariance + covariance).diagonal()[:3].max()))
        return float(np.linalg.norm(moved - way)) > 3.0 * (own + _DRIFT_SIGMA_M)
