"""What an autopilot and its gimbal tell of the camera's turns, with errors of their own.

The table's rows are given none of it, but for one that says so.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np

from companion.geometry import GIMBAL_FROM_CAMERA, GimbalAngles
from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from sitl.camera.pose_sender import GimbalError

_NOISE_RAD = 7e-4  # of a report, per axis, one sigma
_LATE_S = 0.01  # of all reports of a sequence alike, one sigma
_LEVEL = GimbalAngles(0.0, 0.0, 0.0)


class ToldTurns:
    """The camera's rotation as reported along its path, every 20 ms as the path is given.

    Every report errs by the gimbal's alignment and the wander of its horizon, as in the simulated
    flights, and by noise; all come alike late or early. None of it knows the camera's vibration.
    """

    def __init__(self, path: Sequence[tuple[int, Pose]], seed: int) -> None:
        error, rng = GimbalError(seed), np.random.default_rng([seed, 43])
        late_ns = round(1e9 * float(rng.normal(0.0, _LATE_S)))
        self._times_ns = [time_ns + late_ns for time_ns, _ in path]
        self._rotations = [
            pose.rotation @ self._off(error, time_ns, rng) for time_ns, pose in path
        ]  # fmt: skip

    @staticmethod
    def _off(error: GimbalError, time_ns: int, rng: np.random.Generator) -> Array:
        """(3, 3), about the camera's axes."""
        off = error.true_angles(_LEVEL, time_ns)
        angles = np.array([off.roll_rad, off.pitch_rad, off.yaw_rad])
        vector = GIMBAL_FROM_CAMERA.T @ (angles + rng.normal(0.0, _NOISE_RAD, 3))
        return so3_exp(vector)

    def rotation(self, time_ns: int) -> Array | None:
        """world_from_camera (3, 3) as told of a time; None before the first and after the last."""
        k = bisect_right(self._times_ns, time_ns)
        if not 0 < k < len(self._times_ns):
            return None
        before, after = self._rotations[k - 1], self._rotations[k]
        begin_ns, end_ns = self._times_ns[k - 1], self._times_ns[k]
        share = (time_ns - begin_ns) / (end_ns - begin_ns)
        turned: Array = so3_exp(share * so3_log(after @ before.T)) @ before
        return turned
