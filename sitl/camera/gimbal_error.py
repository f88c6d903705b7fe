"""Errors of the gimbal's reported angles: misalignment and a slowly varying attitude error.

Without them, the simulation would give the localizer a perfect attitude.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from companion.geometry import GimbalAngles

_ALIGNMENT_SIGMA = np.radians(0.5)  # per axis, constant over a flight: mounting and calibration
_WANDER_SIGMA = np.radians(0.3)  # per axis: the attitude estimate it is stabilised with
_WANDER_TIME_S = 6.0


class GimbalError:
    """Converts reported gimbal angles to true ones: adds a constant and a first-order Gauss-Markov
    process.

    fault_rad: an additional gross error (roll, pitch, yaw).
    """

    def __init__(self, seed: int, fault_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self._rng = np.random.default_rng([seed, 17])
        self._alignment = self._rng.normal(0.0, _ALIGNMENT_SIGMA, 3) + np.array(fault_rad)
        self._wander = self._rng.normal(0.0, _WANDER_SIGMA, 3)
        self._time_ns: int | None = None

    @property
    def alignment_deg(self) -> tuple[float, float, float]:
        """The constant part: roll, pitch, yaw."""
        roll, pitch, yaw = np.degrees(self._alignment)
        return float(roll), float(pitch), float(yaw)

    def true_angles(self, reported: GimbalAngles, time_ns: int) -> GimbalAngles:
        """The true angles at a time; times must not decrease."""
        self._advance(time_ns)
        roll, pitch, yaw = self._alignment + self._wander
        return replace(
            reported,
            roll_rad=reported.roll_rad + roll,
            pitch_rad=reported.pitch_rad + pitch,
            yaw_rad=reported.yaw_rad + yaw,
        )

    def _advance(self, time_ns: int) -> None:
        elapsed_s = 0.0 if self._time_ns is None else (time_ns - self._time_ns) * 1e-9
        self._time_ns = time_ns
        kept = np.exp(-elapsed_s / _WANDER_TIME_S)
        drive = self._rng.normal(0.0, _WANDER_SIGMA * np.sqrt(1.0 - kept**2), 3)
        self._wander = kept * self._wander + drive
