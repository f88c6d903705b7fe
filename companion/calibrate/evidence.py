"""Residuals of a flight's images and autopilot data for a set of calibration values.

Images: pixels of the map's points. Autopilot: attitude (through the gimbal) and position, at the
timestamp minus the time offset. All frames are evaluated at once, so derivatives are finite
differences: 25 evaluations of some milliseconds. The autopilot's data around each exposure
are kept for any time offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from companion.calibrate import unknowns as u
from companion.calibrate.pictures import Parts
from companion.geometry import GIMBAL_FROM_CAMERA
from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose, matrix_from_quaternion, so3_exp, so3_log
from mavlink_bridge.vehicle.tracker import VehicleTracker


@dataclass(frozen=True)
class CalibrationFrame:
    """One image with the autopilot's data. time_ns: its timestamp; pose: registered."""

    time_ns: int
    pose: Pose
    parts: Parts
    window: AutopilotWindow


@dataclass(frozen=True)
class Guess:
    """All estimated values. shared: (COUNT,), see `UNKNOWNS`; rotations (K, 3, 3), places (K, 3):
    world from camera of every frame.
    """

    shared: Array
    rotations: Array
    places: Array

    def stepped(self, shared: Array, frames: Array) -> Guess:
        """The values after steps (COUNT,) of `shared` and (K, 6) of the frames: metres, and left
        rotation vectors, world axes.
        """
        turned = Rotation.from_rotvec(frames[:, 3:]).as_matrix() @ self.rotations
        return Guess(self.shared + shared, turned, self.places + frames[:, :3])


class CalibrationProblem:
    """Observations of K frames with N patches in all, relative to a deployment's camera model,
    mount (3, 3) and lever arm arm_m (3,). start: the deployment's values and the recorded poses.
    """

    def __init__(
        self, frames: Sequence[CalibrationFrame], camera: Camera, mount: Array, arm_m: Array
    ) -> None:
        self.times_s = np.array([(f.time_ns - frames[0].time_ns) * 1e-9 for f in frames])
        counts = [len(f.parts.points) for f in frames]
        self.owner: NDArray[np.int64] = np.repeat(np.arange(len(frames)), counts)
        self._points = np.concatenate([f.parts.points for f in frames])
        self._pixels = np.concatenate([f.parts.pixels for f in frames])
        information = np.concatenate([f.parts.information for f in frames])
        self._root = np.linalg.cholesky(information).transpose(0, 2, 1)
        self._camera, self._mount, self.arm_m = camera, mount, arm_m
        self._housing = np.array([f.window.camera for f in frames])
        self._body = np.array([f.window.body for f in frames])
        self._place = np.array([f.window.place for f in frames])
        self.placed: NDArray[np.bool_] = np.array([f.window.has_place for f in frames])
        heights = self._place[:, self._place.shape[1] // 2, 2]
        self._ground_m = float(np.nanmin(heights)) if self.placed.any() else 0.0
        self.start = Guess(
            np.zeros(u.COUNT),
            np.array([f.pose.rotation for f in frames]),
            np.array([f.pose.translation for f in frames]),
        )

    @property
    def grounds(self) -> Array:
        """(K, 2): east and north of the ground point in the middle of each image, m."""
        begins = np.flatnonzero(np.diff(self.owner, prepend=-1))
        counts = np.diff(np.append(begins, len(self.owner)))
        middles: Array = np.add.reduceat(self._points[:, :2], begins, axis=0) / counts[:, None]
        return middles

    def pixel_residuals(self, guess: Guess) -> Array:
        """(N, 2): predicted minus measured, weighted by each patch's information, px."""
        away = self._points - guess.places[self.owner]
        x, y, z = np.einsum("nji,nj->in", guess.rotations[self.owner], away)
        c = changed_camera(self._camera, guess.shared)
        xd, yd = c.distorted(x / z, y / z)
        off = np.stack([c.fx * xd + c.cx, c.fy * yd + c.cy], axis=1) - self._pixels
        weighted: Array = np.einsum("nij,nj->ni", self._root, off)
        return weighted

    def attitude_residuals(self, guess: Guess) -> Array:
        """(K, 3): estimated against reported, rotation vectors in the camera's axes, rad."""
        late_s = float(guess.shared[u.LATE])
        heading = so3_exp([0.0, 0.0, -guess.shared[u.HEADING]])  # clockwise from north, in ENU
        mount = self._mount @ so3_exp(guess.shared[u.MOUNT]) @ GIMBAL_FROM_CAMERA
        window = heading @ at_offset(self._housing, -late_s) @ mount
        off = np.swapaxes(window, 1, 2) @ guess.rotations
        turned: Array = Rotation.from_matrix(off).as_rotvec()
        return turned

    def place_residuals(self, guess: Guess) -> Array:
        """(K, 3): estimated minus reported position, metres; NaN where none was reported."""
        late_s, s = float(guess.shared[u.LATE]), guess.shared
        place = at_offset(self._place, -late_s)
        arm = at_offset(self._body, -late_s) @ (self.arm_m + s[u.ARM])
        climbed = (place[:, 2] - self._ground_m) * s[u.CLIMB]
        window = place + arm + s[u.SHIFT]
        window[:, 2] += climbed
        off: Array = guess.places - window
        return off


def changed_camera(camera: Camera, shared: Array) -> Camera:
    """A copy of a camera model with the estimated corrections `shared` (COUNT,), see `UNKNOWNS`."""
    scale = float(np.exp(shared[u.FOCAL]))
    right, down = shared[u.CENTRE]
    bent = np.array(camera.distortion)
    bends = 4 if camera.distortion_model == "opencv" else 2  # a fisheye has no p1, p2
    bent[:bends] += shared[u.BEND][:bends]
    return replace(
        camera, fx=camera.fx * scale, fy=camera.fy * scale, cx=camera.cx + float(right),
        cy=camera.cy + float(down), distortion=tuple(float(k) for k in bent),
    )  # fmt: skip


REACH_S = 0.4  # to both sides of the stamp: offsets beyond it are not looked for
_STEP_S = 0.02
OFFSETS_S: Array = np.arange(-REACH_S, REACH_S + 1e-9, _STEP_S)


@dataclass(frozen=True)
class AutopilotWindow:
    """Autopilot data around one timestamp, at T times `OFFSETS_S` from it; NaN if unknown.

    camera: (T, 3, 3) world from the camera's housing (gimbal axes, x along the boresight), without
    the deployment's mounting correction; body: (T, 3, 3) world from body; place: (T, 3) position by
    the EKF, map ENU, m.
    """

    camera: Array
    body: Array
    place: Array

    @property
    def has_place(self) -> bool:
        """Whether the EKF's position is known at all T times."""
        return bool(np.isfinite(self.place).all())

    def motion(self, offset_s: float = 0.0) -> tuple[Array, Array]:
        """Angular rate of the camera, rad/s, and the vehicle's velocity, m/s (0 if unknown), world
        axes (3,) each, at an offset within `REACH_S`; beyond it, at the window's end.
        """
        n = 3
        middle = round((offset_s + REACH_S) / _STEP_S)
        middle = min(max(middle, n), len(OFFSETS_S) - 1 - n)
        seconds = 2 * n * _STEP_S
        a, b = self.camera[middle - n], self.camera[middle + n]
        way = self.place[middle + n] - self.place[middle - n]
        return so3_log(b @ a.T) / seconds, np.nan_to_num(way / seconds)


def autopilot_window_at(
    autopilot: VehicleTracker, time_ns: int, frame: LocalFrame, geoid_m: float, mount: Array
) -> AutopilotWindow | None:
    """The window around a timestamp; None if attitude or gimbal is unknown at one of its times.

    mount: (3, 3), the deployment's mounting angles. The angles of `gimbal_at` contain them already.
    """
    camera, body, place = [], [], []
    for offset_s in OFFSETS_S:
        t = time_ns + round(1e9 * offset_s)
        attitude, gimbal, where = (
            autopilot.attitude_at(t), autopilot.gimbal_at(t), autopilot.global_at(t)
        )  # fmt: skip
        if attitude is None or gimbal is None:
            return None
        if where is None:
            enu, to_ned = np.full(3, np.nan), frame.ned_from_enu(frame.origin)
        else:
            enu = np.asarray(frame.enu_from_geodetic(where[0], where[1], where[2] + geoid_m))
            to_ned = frame.ned_from_enu(frame.position(enu))
        camera.append(to_ned.T @ matrix_from_quaternion(gimbal.quaternion) @ mount.T)
        body.append(to_ned.T @ matrix_from_quaternion(attitude.quaternion))
        place.append(enu)
    return AutopilotWindow(np.array(camera), np.array(body), np.array(place))


def at_offset(values: Array, offset_s: float) -> Array:
    """Values (K, T, ...) of K timestamps at one offset, linearly interpolated: (K, ...). Beyond
    `REACH_S`, those of the window's end.
    """
    where = np.clip((offset_s + REACH_S) / _STEP_S, 0.0, len(OFFSETS_S) - 1.001)
    i = int(where)
    t = where - i
    between: Array = (1.0 - t) * values[:, i] + t * values[:, i + 1]
    return between
