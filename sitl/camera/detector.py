"""A simulated object detector: sends the pixel positions of known targets in each frame.

It reports only targets that are inside the image and not occluded, with the errors of
`DetectorErrors`.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from companion.targets.detections import Detection, encode_detection, parse_host_port
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.types import Float32


class Observed(Protocol):
    """A target whose true position is known at any time: a `movers.Mover` or a `FixedPoint`."""

    @property
    def name(self) -> str:
        """The label of its detections."""

    def position_at(self, time_ns: int) -> Array:
        """True position (3,), metres in the map's ENU frame, at a CLOCK_MONOTONIC time."""


@dataclass(frozen=True)
class FixedPoint:
    """A point that stays where it is. position: (3,) m, map ENU."""

    name: str
    position: Array

    def position_at(self, time_ns: int) -> Array:
        """See `Observed`."""
        del time_ns
        return self.position


@dataclass(frozen=True)
class DetectorErrors:
    """Errors of the simulated detector. noise_px: 1 sigma per axis. missed, false, swapped: shares
    of the visible targets in each frame that are not reported, are added at a random pixel, or
    exchange their names. box_centre: a moving target is reported at the centre of its box instead
    of its ground point.
    """

    noise_px: float = 1.0
    missed: float = 0.0
    false: float = 0.0
    swapped: float = 0.0
    box_centre: bool = False


_MARGIN_PX = 6.0
_HALF_HEIGHT_M = 0.75  # of a car, a person: the middle of its box above the ground
_DEPTH_TOLERANCE = 0.02  # of the distance; a target lies on a surface that is drawn


@dataclass(frozen=True)
class DetectorView:
    """Truth of one frame for the detector. depth: (H, W) m, in the distorted image; pose_of_row:
    world_from_camera at the exposure of an image row.
    """

    time_ns: int
    depth: Float32
    pose_of_row: Callable[[float], Pose]


class Detector:
    """Sends detections of `targets` as UDP datagrams to `address` ("host:port")."""

    def __init__(
        self,
        address: str,
        camera: Camera,
        targets: Sequence[Observed],
        errors: DetectorErrors | None = None,
        seed: int = 0,
    ) -> None:
        self._address = parse_host_port(address)
        self._camera = camera
        self._targets = tuple(targets)
        self._errors = errors or DetectorErrors()
        self._false = 0
        self._rng = np.random.default_rng([seed, 5])
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def observe(self, view: DetectorView, stamp_ns: int | None = None) -> list[Detection]:
        """Detect the targets in one frame, send the detections and return them. stamp_ns: time
        stamp of the frame in the video stream, used for the detections; None: the true time.
        """
        stamp_ns = view.time_ns if stamp_ns is None else stamp_ns
        seen = [d for t in self._targets if (d := self._detected(t, view, stamp_ns)) is not None]
        reported = self._mistaken(seen, stamp_ns)
        for detection in reported:
            self._socket.sendto(encode_detection(detection), self._address)
        return reported

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _detected(self, target: Observed, view: DetectorView, stamp_ns: int) -> Detection | None:
        errors = self._errors
        place = target.position_at(view.time_ns)
        if errors.box_centre and not isinstance(target, FixedPoint):
            place = place + np.array([0.0, 0.0, _HALF_HEIGHT_M])
        pixel = self._visible(place, view)
        if pixel is None or self._rng.random() < errors.missed:
            return None
        u, v = pixel + self._rng.normal(0.0, errors.noise_px, 2)
        return Detection(target.name, stamp_ns, float(u), float(v))

    def _mistaken(self, seen: list[Detection], stamp_ns: int) -> list[Detection]:
        """The detections with two names exchanged or a false one added, as often as
        `DetectorErrors` says.
        """
        if not seen:
            return seen
        found = list(seen)
        if len(found) > 1 and self._rng.random() < self._errors.swapped:
            i, k = self._rng.choice(len(found), 2, replace=False)
            a, b = found[i], found[k]
            found[i], found[k] = replace(a, u=b.u, v=b.v), replace(b, u=a.u, v=a.v)
        if self._rng.random() < self._errors.false:
            u, v = self._rng.uniform((0, 0), (self._camera.width, self._camera.height))
            self._false += 1
            found.append(Detection(f"no-target-{self._false}", stamp_ns, float(u), float(v)))
        return found

    def _visible(self, place: Array, view: DetectorView) -> Array | None:
        depth = view.depth
        point = view.pose_of_row(self._camera.height / 2 - 0.5).inverse.apply(place)
        pixel, inside = self._camera.project(point)
        if inside:  # where it is while its own row is exposed
            point = view.pose_of_row(float(pixel[1]) - 0.5).inverse.apply(place)
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
