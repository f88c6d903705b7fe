"""The operator's eye, simulated: pixels of known targets in each frame, sent as detections.

It knows the truth, adds a pixel's noise and reports only what a viewer could see: in the picture
and not hidden behind something nearer.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from companion.targets.detections import Detection, encode_detection, parse_host_port
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.types import Float32


class Observed(Protocol):
    """Something whose place is known at any time: a `movers.Mover` or a `FixedPoint`."""

    @property
    def name(self) -> str:
        """What the detections call it."""

    def position_at(self, time_ns: int) -> Array:
        """(3,) world metres at a time on CLOCK_MONOTONIC."""


@dataclass(frozen=True)
class FixedPoint:
    """A point that stays where it is. position: (3,) world metres."""

    name: str
    position: Array

    def position_at(self, time_ns: int) -> Array:
        """See `Observed`."""
        del time_ns
        return self.position


_MARGIN_PX = 6.0
_DEPTH_TOLERANCE = 0.02  # of the distance; a target lies on a surface that is drawn


class Detector:
    """Sends detections of `targets` to `address` ("host:port")."""

    def __init__(
        self,
        address: str,
        camera: Camera,
        targets: Sequence[Observed],
        noise_px: float = 1.0,
        seed: int = 0,
    ) -> None:
        self._address = parse_host_port(address)
        self._camera = camera
        self._targets = tuple(targets)
        self._noise_px = noise_px
        self._rng = np.random.default_rng([seed, 5])
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def observe(self, time_ns: int, world_from_camera: Pose, depth: Float32) -> list[Detection]:
        """Send and return what is visible in a frame. depth: (H, W) of the distorted picture."""
        seen = []
        for target in self._targets:
            point = world_from_camera.inverse.apply(target.position_at(time_ns))
            pixel = self._visible(point, depth)
            if pixel is not None:
                u, v = pixel + self._rng.normal(0.0, self._noise_px, 2)
                seen.append(Detection(target.name, time_ns, float(u), float(v)))
        for detection in seen:
            self._socket.sendto(encode_detection(detection), self._address)
        return seen

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _visible(self, point: Array, depth: Float32) -> Array | None:
        pixel, inside = self._camera.project(point)
        size = (self._camera.width, self._camera.height)
        if not inside or (pixel < _MARGIN_PX).any() or (pixel > np.array(size) - _MARGIN_PX).any():
            return None
        # The lens model folds far outside the view back into it: trust only near the axis' cone.
        if np.abs(point[:2] / point[2]).max() > 0.75 * max(size) / self._camera.fx:
            return None
        u, v = pixel.astype(int)
        nearest = float(depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].max())
        return pixel if point[2] <= nearest * (1 + _DEPTH_TOLERANCE) + 0.5 else None
