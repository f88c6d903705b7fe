"""Imperfections of a real camera: rolling shutter, vibration, inaccurate time stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Pose, so3_exp
from sitl.camera.true_motion import PoseTrack

_VIBRATION_HZ = (15.0, 90.0)  # propellers, and what the damper leaves of them
_WAVES = 3


@dataclass(frozen=True)
class CameraRealism:
    """Imperfections of the simulated camera; the defaults are a perfect one.

    readout_ms: time between the exposures of the first and the last row. vibration_deg: RMS per
    axis. auto_exposure: whether the gain follows the image's brightness. supersample: rendered
    pixels per pixel and axis. packet_loss: share of lost datagrams. stamp_offset_ms,
    stamp_jitter_ms: constant error of the timestamps, and its standard deviation.
    """

    readout_ms: float = 0.0
    vibration_deg: float = 0.0
    auto_exposure: bool = False
    supersample: float = 1.0
    packet_loss: float = 0.0
    stamp_offset_ms: float = 0.0
    stamp_jitter_ms: float = 0.0


class Vibration:
    """Random small rotations of the camera about its own axes, a pure function of time."""

    def __init__(self, rms_deg: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 29])
        self._rms = np.radians(rms_deg)
        self._omega = 2 * np.pi * rng.uniform(*_VIBRATION_HZ, (3, _WAVES))
        self._phase = rng.uniform(0, 2 * np.pi, (3, _WAVES))

    def vibrating(self, pose: Pose, time_ns: int) -> Pose:
        """world_from_camera with the vibration of a time added."""
        if self._rms == 0:
            return pose
        waves = np.sin(self._omega * (time_ns * 1e-9) + self._phase).sum(axis=1)
        turn = self._rms * np.sqrt(2.0 / _WAVES) * waves
        return Pose(pose.rotation @ so3_exp(turn), pose.translation)


class VibratingTrack:
    """A camera trajectory with vibration, with the interface of `PoseTrack`."""

    def __init__(self, track: PoseTrack, vibration: Vibration) -> None:
        self._track, self._vibration = track, vibration

    def at(self, time_ns: int) -> Pose | None:
        """world_from_camera at a time; None outside the track."""
        pose = self._track.at(time_ns)
        return None if pose is None else self._vibration.vibrating(pose, time_ns)


class CameraClock:
    """Makes the time stamps of the simulated camera, with its offset and jitter."""

    def __init__(self, realism: CameraRealism, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 31])
        self._offset_ns = realism.stamp_offset_ms * 1e6
        self._jitter_ns = realism.stamp_jitter_ms * 1e6
        self._last_ns = -(2**62)

    def of(self, exposure_ns: int) -> int:
        """The timestamp of a frame exposed at `exposure_ns`. Timestamps always increase."""
        noise = self._jitter_ns * float(self._rng.standard_normal()) if self._jitter_ns else 0.0
        stamp = exposure_ns + round(self._offset_ns + noise)
        self._last_ns = max(stamp, self._last_ns + 1)
        return self._last_ns
