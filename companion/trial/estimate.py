"""Estimates camera mounting, focal length and map offset of footage, by `companion.calibrate`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.calibrate import unknowns as u
from companion.calibrate.evidence import (
    OFFSETS_S,
    AutopilotWindow,
    CalibrationFrame,
    CalibrationProblem,
    changed_camera,
)
from companion.calibrate.pictures import Parts, PictureReader
from companion.calibrate.solve import Solution, solve
from companion.errors import StreamDecodeError, StreamSizeError
from companion.geometry import GIMBAL_FROM_CAMERA
from companion.recorded.flight import CameraGuess, RecordedFrame
from companion.trial.localize import FrameLocalizer, Localized
from companion.trial.priors import Correction, FramePrior
from localizer.features.extractor import FeatureExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.render.base import MapRenderer

LEAST_FRAMES = 4
_TURNS = 2  # with the camera as given, and with the one that was found
_MOST_FRAMES = 40  # more of them tell little that these do not
_RELIEF_SHARE = 0.004  # of the height above ground: flatter ground shows no focal length
_SIGNIFICANT = 3.0  # sigmas: the given focal length is kept unless it differs by so much
_UP_SIGMA_M = 10.0  # of the map's surface against the height that is recorded
_OUTLIER_SHARE, _OUTLIER_SIGMAS = 0.1, 3.0  # of the height above ground; of the median deviation
_ROBUST_ROUNDS = 10
_LEAST_TILT_DEG = 0.5


@dataclass(frozen=True)
class Estimated:
    """Estimated errors of camera, gimbal and map.

    camera: with the estimated focal length, or the given one if they differ by less than three
    sigmas. focal_percent: difference from the given focal length; None if this map cannot show it.
    mount_deg: (3,) of the camera on the gimbal: turn about the optical axis, up, right. shift_m:
    (3,) map minus GNSS, east, north, up. has_shift: whether recorded positions show the shift.
    poses: of the frames used, by frame number.
    """

    camera: Camera
    correction: Correction
    focal_percent: float | None
    focal_sigma_percent: float
    mount_deg: Array
    mount_sigma_deg: Array
    shift_m: Array
    shift_sigma_m: Array
    has_shift: bool
    poses: dict[int, Pose]
    pixel_sigma: float

    @property
    def frame_count(self) -> int:
        """Number of frames used."""
        return len(self.poses)


@dataclass(frozen=True)
class EstimateTools:
    """Renderer and extractor for images over the map. width: pixels of the images compared;
    has_buildings: whether the map's heights contain buildings.
    """

    renderer: MapRenderer
    extractor: FeatureExtractor
    width: int
    has_buildings: bool = True


def estimate(
    frames: Sequence[RecordedFrame],
    priors: Sequence[FramePrior],
    localized: Sequence[Localized],
    guess: CameraGuess,
    tools: EstimateTools,
    loader: FrameLocalizer,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Estimated | None:
    """Estimate the errors of focal length, mounting angles and map offset.

    frames, priors and localized have one entry for each frame, in the same order. guess: the camera
    as given. At most 40 consistent frames are used, spread over all. progress: called with the
    numbers of frames done and in all; each frame is used twice. None if fewer than four frames are
    consistent, or fewer than four of the used ones can be read and matched.
    """
    used = consistent_frames(priors, localized)
    if len(used) > _MOST_FRAMES:
        used = [used[int(k)] for k in np.linspace(0, len(used) - 1, _MOST_FRAMES).round()]
    if len(used) < LEAST_FRAMES:
        return None
    poses = {k: pose for k in used if (pose := localized[k].pose) is not None}
    shared, solution, camera = np.zeros(u.COUNT), None, guess.camera
    focal: tuple[float, float] | None = None
    fixed = np.ones(u.COUNT, bool)
    for turn in range(_TURNS):
        believed = changed_camera(guess.camera, shared)
        reader = PictureReader(tools.renderer, tools.extractor, believed, tools.width)
        sighted: dict[int, CalibrationFrame] = {}
        for number, (k, pose) in enumerate(poses.items(), 1):
            progress(turn * len(used) + number, _TURNS * len(used))
            parts = _parts(frames[k], pose, believed, reader, loader)
            if parts is not None:
                said = _telemetry_window(priors[k], pose)
                sighted[k] = CalibrationFrame(10_000_000_000 * (k + 1), pose, parts, said)
        if len(sighted) < LEAST_FRAMES:
            return None
        fixed = _fixed_parameters(list(sighted.values()), tools.has_buildings)
        evidence = CalibrationProblem(list(sighted.values()), guess.camera, np.eye(3), np.zeros(3))
        solution = solve(evidence, fixed, _sigmas(guess))
        focal = _focal(solution, fixed)
        if focal is not None and abs(focal[0]) < _SIGNIFICANT * focal[1]:
            fixed[u.FOCAL] = True
            solution = solve(evidence, fixed, _sigmas(guess))
        shared = solution.guess.shared
        camera = changed_camera(guess.camera, shared)
        found = zip(sighted, solution.guess.rotations, solution.guess.places, strict=True)
        poses = {k: Pose(R, t) for k, R, t in found}
    if solution is None:
        return None
    return _estimated(camera, solution, focal, priors, poses)


def consistent_frames(priors: Sequence[FramePrior], localized: Sequence[Localized]) -> list[int]:
    """Indices of the localized frames whose error of the ground point on the optical axis fits that
    of most others: one map offset plus one tilt error.

    The ground point is used because correlated errors of position and tilt cancel there. If fewer
    than four frames have a recorded position and height, all accepted frames.
    """
    which = [k for k, one in enumerate(localized) if one.pose is not None]
    placed = [k for k in which if priors[k].pose is not None and priors[k].height_known]
    if len(placed) < LEAST_FRAMES:
        return [k for k in which if localized[k].accepted]
    rows, values, heights = [], [], []
    for k in placed:
        pose, prior = localized[k].pose, priors[k].pose
        if pose is None or prior is None:
            continue
        height = priors[k].clearance_m
        away = _axis_ground(pose, height) - _axis_ground(prior, height)
        yaw = float(np.arctan2(-prior.rotation[1, 1], -prior.rotation[0, 1]))  # of the image's top
        ahead = np.array([np.cos(yaw), np.sin(yaw)])
        beside = np.array([ahead[1], -ahead[0]])
        rows.append(np.column_stack([np.eye(2), height * ahead, height * beside]))
        values.append(away)
        heights.append(height)
    A, b = np.array(rows), np.array(values)
    weight = np.ones(len(b))
    for _ in range(_ROBUST_ROUNDS):
        flat = (A * weight[:, None, None]).reshape(-1, 4)
        normal = flat.T @ flat + np.diag([1e-4, 1e-4, 1e-2, 1e-2])
        x = np.linalg.solve(normal, flat.T @ (b * weight[:, None]).ravel())
        off = np.linalg.norm(b - A @ x, axis=1)
        scale = max(float(np.median(off)), 0.5)
        weight = 1.0 / (1.0 + (off / scale) ** 2)
    limit = np.maximum(_OUTLIER_SIGMAS * scale, _OUTLIER_SHARE * np.array(heights))
    return [k for k, good in zip(placed, off <= limit, strict=True) if good]


def _axis_ground(pose: Pose, height_m: float) -> Array:
    """(2,) east, north where the optical axis meets flat ground height_m below the camera."""
    axis = pose.rotation[:, 2]
    down = max(-float(axis[2]), 0.2)
    return np.asarray(pose.translation[:2] + axis[:2] * height_m / down)


def _parts(
    recorded: RecordedFrame, pose: Pose, camera: Camera, reader: PictureReader,
    loader: FrameLocalizer,
) -> Parts | None:  # fmt: skip
    if recorded.telemetry.zoom != 1.0:
        return None  # of another focal length
    try:
        frame = loader.load(recorded)
    except (StreamDecodeError, StreamSizeError, OSError):
        return None
    return reader.read(replace(frame, camera=camera), pose, None)


def _telemetry_window(prior: FramePrior, pose: Pose) -> AutopilotWindow:
    """The frame's telemetry for the calibration, equal at all time offsets, because no time offset
    is estimated. An unknown heading is taken from the registration `pose`.
    """
    rotation = prior.rotation
    if prior.heading_sigma_deg is None:
        turn = float(np.arctan2(*(pose.rotation @ rotation.T)[[1, 0], 0]))
        rotation = np.asarray(so3_exp([0.0, 0.0, turn]) @ rotation)
    housing = rotation @ GIMBAL_FROM_CAMERA.T
    known = prior.pose is not None and prior.height_known
    place = prior.pose.translation if known and prior.pose is not None else np.full(3, np.nan)
    count = len(OFFSETS_S)
    return AutopilotWindow(
        np.repeat(housing[None], count, 0), np.repeat(housing[None], count, 0),
        np.repeat(place[None], count, 0),
    )  # fmt: skip


def _fixed_parameters(sighted: Sequence[CalibrationFrame], has_buildings: bool) -> np.ndarray:
    """Which calibration parameters keep their value: all but focal length, mounting and map offset.
    The focal length is fixed, too, over flat ground, because it cannot be separated from the
    height, and over a map without buildings, because buildings in the image are nearer than the
    map's ground.
    """
    fixed = np.ones(u.COUNT, bool)
    fixed[u.MOUNT], fixed[u.SHIFT] = False, False
    is_flat = float(np.median([_relief(s) for s in sighted])) < _RELIEF_SHARE
    fixed[u.FOCAL] = is_flat or not has_buildings
    return fixed


def _relief(one: CalibrationFrame) -> float:
    """Deviation of an image's ground from a plane (1 sigma), as a share of the height above it."""
    points = one.parts.points
    design = np.column_stack([points[:, :2] - points[:, :2].mean(axis=0), np.ones(len(points))])
    left = points[:, 2] - design @ np.linalg.lstsq(design, points[:, 2], rcond=None)[0]
    height = float(one.pose.translation[2] - points[:, 2].mean())
    return float(left.std()) / max(height, 1.0)


def _sigmas(guess: CameraGuess) -> Array:
    sigmas: Array = u.SIGMAS.copy()
    sigmas[u.FOCAL] = guess.focal_percent / 100.0
    sigmas[u.SHIFT][2] = _UP_SIGMA_M
    return sigmas


def _focal(solution: Solution, fixed: np.ndarray) -> tuple[float, float] | None:
    """Focal length minus the given one, and its sigma, per cent; None if it was fixed."""
    if fixed[u.FOCAL]:
        return None
    difference = float(np.expm1(solution.guess.shared[u.FOCAL]))
    return 100.0 * difference, 100.0 * float(np.sqrt(solution.covariance[u.FOCAL, u.FOCAL]))


def _estimated(
    camera: Camera,
    solution: Solution,
    focal: tuple[float, float] | None,
    priors: Sequence[FramePrior],
    poses: dict[int, Pose],
) -> Estimated:
    shared, sigma = solution.guess.shared, np.sqrt(np.diag(solution.covariance))
    has_shift = any(priors[k].pose is not None and priors[k].height_known for k in poses)
    shift, shift_sigma = shared[u.SHIFT].copy(), sigma[u.SHIFT].copy()
    if not has_shift:
        shift, shift_sigma, has_shift = _horizontal_shift(priors, poses)
    housing = so3_exp(shared[u.MOUNT])
    mount = GIMBAL_FROM_CAMERA.T @ housing @ GIMBAL_FROM_CAMERA
    left = max(float(np.degrees(solution.attitude.sigma[:3].max())), _LEAST_TILT_DEG)
    percent, percent_sigma = (None, 0.0) if focal is None else focal
    return Estimated(
        camera, Correction(np.asarray(mount), shift, left), percent, percent_sigma,
        np.degrees(shared[u.MOUNT]), np.degrees(sigma[u.MOUNT]), shift, shift_sigma, has_shift,
        poses, solution.pixel_sigma,
    )  # fmt: skip


def _horizontal_shift(
    priors: Sequence[FramePrior], poses: dict[int, Pose]
) -> tuple[Array, Array, bool]:
    """Horizontal offset and sigma (m) from positions without height; whether there is one."""
    away = [
        pose.translation[:2] - prior.translation[:2]
        for k, pose in poses.items()
        if (prior := priors[k].pose) is not None
    ]
    if len(away) < LEAST_FRAMES:
        return np.zeros(3), np.full(3, np.inf), False
    middle = np.median(away, axis=0)
    spread = 1.48 * np.median(np.abs(np.array(away) - middle), axis=0) / np.sqrt(len(away))
    return np.array([*middle, 0.0]), np.array([*spread, np.inf]), True
