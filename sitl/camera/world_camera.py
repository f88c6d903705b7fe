"""Renders the view of the simulated aircraft's camera from its true pose, through its lens.

`WorldCamera` renders one frame. `sitl.camera.process` streams frames; `sitl.demo.kinematic` writes
them as an evaluation sequence.

`Sensor` is `synth.appearance.model` in two passes over the image. The general function is as slow
as rendering, and the world camera shares two cores with the companion under test. Lamps, rain and
snow are left to the general function.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, quaternion_from_matrix
from localizer.geometry.trajectory import StampedPose, tum_line
from localizer.render.base import MapRenderer
from localizer.synth.appearance.model import Appearance, apply_appearance
from localizer.types import Float32, Image, RenderedView
from sitl.camera.movers import Mover
from sitl.camera.realism import CameraRealism, VibratingTrack, Vibration
from sitl.camera.true_motion import PoseTrack

_SKY_M = 4000.0  # haze distance of pixels without a surface, as in the general function
_CURVE_MAX, _CURVE_SIZE = 2.0, 8192  # tone curve: input range and number of entries
_NOISE_SIZE = 1 << 20
_GRAY = (0.299, 0.587, 0.114)


_BRIGHTNESS = 0.42  # of full scale: what automatic exposure aims at
_FOLLOWS = 0.25  # of the way there that the gain goes from one picture to the next
_GAIN = (0.5, 3.0)


class Sensor:
    """Applies exposure, noise, blur and weather to rendered frames, one after another. With
    auto_exposure, the gain follows the last frame's brightness, and the noise grows with it.
    """

    def __init__(self, appearance: Appearance, seed: int = 0, auto_exposure: bool = False) -> None:
        self._appearance = appearance
        self._auto, self._gain = auto_exposure, 1.0
        self._rng = np.random.default_rng(seed)
        a = appearance
        self._is_simple = not (a.lamps or a.rain_streaks or a.snow_flakes or a.snow_cover)
        x = np.linspace(0.0, _CURVE_MAX, _CURVE_SIZE)
        self._curve = (x**a.gamma).astype(np.float32)
        self._noise = self._rng.standard_normal(_NOISE_SIZE, dtype=np.float32)

    def apply(self, rgb: Image, depth: Float32, blur_px: float, blur_deg: float) -> Image:
        """The camera's image (H, W, 3) of a rendered one. depth: (H, W) m, 0 for sky. blur_px,
        blur_deg: length and direction of the image motion.
        """
        a = replace(self._appearance, motion_blur_px=blur_px, motion_blur_deg=blur_deg)
        if not self._auto:
            return self._developed(rgb, depth, a)
        gain = self._gain
        gained = replace(
            a, exposure=a.exposure * gain, shot_noise=a.shot_noise * float(np.sqrt(gain)),
            read_noise=a.read_noise * gain,
        )  # fmt: skip
        image = self._developed(rgb, depth, gained)
        level = max(float(image[::8, ::8].mean()) / 255.0, 1e-3)
        wanted = gain * (_BRIGHTNESS / level) ** _FOLLOWS
        self._gain = min(max(wanted, _GAIN[0]), _GAIN[1])
        return image

    def _developed(self, rgb: Image, depth: Float32, a: Appearance) -> Image:
        if not self._is_simple:
            return apply_appearance(rgb, depth, a, self._rng)
        gain, offset = _linear_tone(rgb, a)
        haze = np.array(a.haze_color) * min(a.exposure, 1.0)
        image = np.empty(rgb.shape, np.float32)
        _develop(
            rgb, depth, gain, offset, self._curve, _f32(a.extinction_per_m), _f32(haze),
            _f32(0.5 * a.vignetting), image,
        )  # fmt: skip
        # The general function's thresholds for when a blur is drawn.
        if a.defocus_px > 0.3:
            image = cv2.GaussianBlur(image, (0, 0), a.defocus_px)
        if a.motion_blur_px > 1.0:
            image = cv2.filter2D(image, -1, line_kernel(a.motion_blur_px, a.motion_blur_deg))
        out = np.empty(rgb.shape, np.uint8)
        start = int(self._rng.integers(_NOISE_SIZE))
        shot, read = _f32(a.shot_noise**2), _f32(a.read_noise**2)
        _expose(image.reshape(-1), self._noise, start, shot, read, out.reshape(-1))
        return out if a.jpeg_quality == 100 else _compressed(out, a.jpeg_quality)


def line_kernel(length_px: float, angle_deg: float) -> Float32:
    """Blur kernel (K, K) of a straight motion, anti-aliased, centred, with sum 1."""
    half = int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    t = np.linspace(-0.5, 0.5, 65) * length_px
    angle = np.radians(angle_deg)
    x, y = half + t * np.cos(angle), half + t * np.sin(angle)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    for dx, wx in ((0, 1 - (x - x0)), (1, x - x0)):
        for dy, wy in ((0, 1 - (y - y0)), (1, y - y0)):
            np.add.at(kernel, (y0 + dy, x0 + dx), wx * wy)
    normalised: Float32 = kernel / kernel.sum()
    return normalised


def _linear_tone(rgb: Image, a: Appearance) -> tuple[Float32, Float32]:
    """Saturation, balance, exposure and contrast as one affine map of colour: (3, 3) and (3,)."""
    gray = np.array(_GRAY)
    saturate = a.saturation * np.eye(3) + (1 - a.saturation) * gray[None, :]
    matrix = np.diag(np.array(a.balance) * a.exposure) @ saturate
    # Contrast turns about the mean of the image as it is by then; all before it is linear.
    mean = float((matrix @ (np.array(cv2.mean(rgb)[:3]) / 255)).mean())
    return _f32(a.contrast * matrix / 255), _f32(np.full(3, (1 - a.contrast) * mean))


def _compressed(image: Image, quality: int) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def _f32(value: Any) -> Any:
    return np.asarray(value, np.float32) if np.ndim(value) else np.float32(value)


@njit(cache=True, nogil=True, fastmath=True)
def _develop(rgb, depth, gain, offset, curve, extinction, haze, falloff, out):  # type: ignore[no-untyped-def]
    """Tone, haze by distance, vignetting: (H, W, 3) uint8 to float32."""
    h, w = depth.shape
    scale = np.float32((curve.shape[0] - 1) / _CURVE_MAX)
    top = np.float32(curve.shape[0] - 1)
    step_x, step_y = np.float32(2.0 / (w - 1)), np.float32(2.0 / (h - 1))
    one = np.float32(1)
    for v in range(h):
        y = v * step_y - one
        for u in range(w):
            x = u * step_x - one
            r, g, b = np.float32(rgb[v, u, 0]), np.float32(rgb[v, u, 1]), np.float32(rgb[v, u, 2])
            d = depth[v, u]
            clear = one
            if extinction > 0:
                clear = np.exp(-extinction * (d if d > 0 else np.float32(_SKY_M)))
            light = one - falloff * (x * x + y * y)
            for c in range(3):
                value = gain[c, 0] * r + gain[c, 1] * g + gain[c, 2] * b + offset[c]
                index = min(max(value * scale, np.float32(0)), top)
                value = curve[int(index + np.float32(0.5))]
                out[v, u, c] = (value * clear + haze[c] * (one - clear)) * light


@njit(cache=True, nogil=True, fastmath=True)
def _expose(image, noise, start, shot, read, out):  # type: ignore[no-untyped-def]
    """Shot and read noise, and 8 bits; flat arrays."""
    mask = noise.shape[0] - 1
    for i in range(image.shape[0]):
        value = image[i]
        level = min(max(value, np.float32(0)), np.float32(1))
        value += noise[(start + i) & mask] * np.sqrt(shot * level + read)
        value = min(max(value, np.float32(0)), np.float32(1))
        out[i] = np.uint8(value * np.float32(255) + np.float32(0.5))


_ROWS_APART = 16
_ROLLING_MARGIN_PX = 8.0  # rows that are exposed before and after look past the frame


@dataclass(frozen=True)
class RenderedLens:
    """A distorted `camera` and the `pinhole` to render for it; they share the optical centre.

    rays: (H, W, 2) float32, x / z and y / z of every pixel. maps: fixed-point maps for
    ``cv2.remap`` from the pinhole's image to the camera's.
    """

    camera: Camera
    pinhole: Camera
    rays: Float32
    maps: tuple[NDArray[np.int16], NDArray[np.uint16]]

    @classmethod
    def of(cls, camera: Camera, supersample: float = 1.0, is_rolling: bool = False) -> RenderedLens:
        """Choose the smallest pinhole camera that covers all rays of `camera`. supersample:
        resolution factor. is_rolling: adds a margin for the rolling shutter.
        """
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = camera.rays(np.stack([u, v], axis=-1) + 0.5)
        fx, fy = supersample * camera.fx, supersample * camera.fy
        x, y = rays[..., 0] * fx, rays[..., 1] * fy
        # One more pixel all around, for the bilinear look-up at the borders.
        margin = 1 + (supersample * _ROLLING_MARGIN_PX if is_rolling else 0)
        left, right = np.floor(x.min()) - margin, np.ceil(x.max()) + margin
        top, bottom = np.floor(y.min()) - margin, np.ceil(y.max()) + margin
        size = int(right - left), int(bottom - top)
        pinhole = Camera(*size, fx, fy, -float(left), -float(top))
        # OpenCV counts from the first pixel's centre.
        source = np.stack([x - left - 0.5, y - top - 0.5], axis=-1).astype(np.float32)
        coordinates, weights = cv2.convertMaps(source, None, cv2.CV_16SC2)
        flat = rays[..., :2].astype(np.float32)
        return cls(camera, pinhole, flat, (coordinates.astype(np.int16), weights.astype(np.uint16)))

    def distort(self, image: Image) -> Image:
        """Warp an image (H, W, 3) of the pinhole to the distorted camera."""
        return np.asarray(cv2.remap(image, *self.maps, cv2.INTER_LINEAR))

    def distort_depth(self, depth: Float32) -> Float32:
        """Warp a depth image (H, W) of the pinhole to the distorted camera (nearest neighbour)."""
        return np.asarray(cv2.remap(depth, self.maps[0], None, cv2.INTER_NEAREST))

    def roll(self, image: Image, depth: Float32, middle_from_row: Array) -> tuple[Image, Float32]:
        """Warp image and depth of the pinhole for lens distortion and rolling shutter.

        middle_from_row: (H, 3, 4), see `row_motion`. The depth gets the lens distortion only: the
        motion during a readout is a few pixels, so only silhouettes have an error.
        """
        still = self.distort_depth(depth)
        p = self.pinhole
        intrinsics = np.array([p.fx, p.fy, p.cx, p.cy], np.float32)
        source = np.empty((*still.shape, 2), np.float32)
        _row_maps(self.rays, still, np.float32(middle_from_row), intrinsics, source)
        edge = cv2.BORDER_REPLICATE
        bent = cv2.remap(image, source, None, cv2.INTER_LINEAR, None, edge)
        return np.asarray(bent), still


def row_motion(middle: Pose, pose_of_row: Callable[[float], Pose], height: int) -> Array:
    """Rigid transforms (H, 3, 4) from the camera at each row's exposure time to the camera at the
    middle row's, for a rolling shutter.

    pose_of_row: world_from_camera of a row; called for every few rows and interpolated.
    """
    rows = np.arange(height)
    known = np.append(np.arange(0, height - 1, _ROWS_APART), height - 1)
    motion = np.stack([(middle.inverse @ pose_of_row(float(row))).matrix[:3] for row in known])
    flat = motion.reshape(len(known), 12)
    each = [np.interp(rows, known, flat[:, k]) for k in range(12)]
    return np.stack(each, axis=1).reshape(height, 3, 4)


@njit(cache=True, nogil=True, fastmath=True)
def _row_maps(rays, depth, motion, intrinsics, out):  # type: ignore[no-untyped-def]
    """Write to `out` (H, W, 2) where ``cv2.remap`` looks each pixel up in the pinhole's image."""
    half, far = np.float32(0.5), np.float32(1e4)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for v in range(depth.shape[0]):
        m = motion[v]
        for u in range(depth.shape[1]):
            d = depth[v, u]
            if d <= 0:
                d = far
            x, y = rays[v, u, 0] * d, rays[v, u, 1] * d
            px = m[0, 0] * x + m[0, 1] * y + m[0, 2] * d + m[0, 3]
            py = m[1, 0] * x + m[1, 1] * y + m[1, 2] * d + m[1, 3]
            pz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * d + m[2, 3]
            out[v, u, 0] = px / pz * fx + cx - half
            out[v, u, 1] = py / pz * fy + cy - half


SHUTTER_S = 0.005
FRAME_COLUMNS = (
    "exposure_time_ns", "sequence", "east_m", "north_m", "up_m", "qw", "qx", "qy", "qz",
    "true_time_ns",
)  # fmt: skip


@dataclass(frozen=True)
class Exposure:
    """A rendered frame and its truth. image: (H, W, 3) uint8, distorted, with noise, blur and
    weather; depth: (H, W) m along the optical axis, distorted likewise. world_from_camera: at
    time_ns, the exposure of the middle row; pose_of_row: gives the pose of any row.
    """

    image: Image
    depth: Float32
    time_ns: int
    world_from_camera: Pose
    pose_of_row: Callable[[float], Pose]


@dataclass(frozen=True)
class CameraOptions:
    """Moving objects and imperfections of a `WorldCamera`.

    scene_from_world: from the map's ENU, of poses and movers, to the ENU of the renderer's own
    cache. shutter_s: exposure time, for the motion blur. seed: of noise and vibration.
    """

    movers: tuple[Mover, ...] = ()
    scene_from_world: Pose = field(default_factory=Pose.identity)
    shutter_s: float = SHUTTER_S
    seed: int = 0
    realism: CameraRealism = field(default_factory=CameraRealism)


class WorldCamera:
    """Renders the live world (which may differ from the map) as a real camera would see it."""

    def __init__(
        self,
        renderer: MapRenderer,
        camera: Camera,
        appearance: Appearance,
        options: CameraOptions | None = None,
    ) -> None:
        options = options or CameraOptions()
        self.camera = camera
        self._renderer = renderer
        real = options.realism
        self._lens = RenderedLens.of(camera, real.supersample, real.readout_ms > 0)
        self._sensor = Sensor(appearance, options.seed, real.auto_exposure)
        self._vibration = Vibration(real.vibration_deg, options.seed)
        self._row_ns = real.readout_ms * 1e6 / camera.height
        self._movers = options.movers
        self._scene_from_world = options.scene_from_world
        self._shutter_ns = round(options.shutter_s * 1e9)

    def expose(self, time_ns: int, track: PoseTrack) -> Exposure | None:
        """Render the frame at a time; None if `track` has no pose at that time."""
        vibrating = VibratingTrack(track, self._vibration)
        pose = vibrating.at(time_ns)
        if pose is None:
            return None

        def pose_of_row(row: float) -> Pose:
            away_ns = round((row + 0.5 - self.camera.height / 2) * self._row_ns)
            return vibrating.at(time_ns + away_ns) or pose

        view = self._render(pose, time_ns)
        if self._row_ns:
            motion = row_motion(pose, pose_of_row, self.camera.height)
            image, depth = self._lens.roll(view.rgb, view.depth, motion)
        else:
            image, depth = self._lens.distort(view.rgb), self._lens.distort_depth(view.depth)
        length_px, angle_deg = self._blur(vibrating, pose, depth, time_ns)
        image = self._sensor.apply(image, depth, length_px, angle_deg)
        return Exposure(image, depth, time_ns, pose, pose_of_row)

    def _render(self, pose: Pose, time_ns: int) -> RenderedView:
        extra = []
        for mover in self._movers:
            mesh = mover.placed_at(time_ns)
            extra.append(mesh.placed(self._scene_from_world @ mesh.world_from_tile))
        scene = self._scene_from_world @ pose
        # Waiting for detail: a real camera does not show coarse ground while data is loading.
        return self._renderer.render(scene, self._lens.pinhole, extra, wait=True)

    def _blur(
        self, track: VibratingTrack, pose: Pose, depth: Float32, time_ns: int
    ) -> tuple[float, float]:
        """Length (pixels) and direction (degrees) of the image motion while the shutter is open."""
        before = track.at(time_ns - self._shutter_ns // 2) or pose
        after = track.at(time_ns + self._shutter_ns // 2) or pose
        flow = centre_flow(before, after, self.camera, _typical_depth(depth))
        return float(np.hypot(*flow)), float(np.degrees(np.arctan2(flow[1], flow[0])))


def centre_flow(before: Pose, after: Pose, camera: Camera, depth_m: float) -> Array:
    """Image motion (2,) px, between two poses, of the point depth_m in front of the first."""
    point = before.apply(np.array([0.0, 0.0, depth_m]))
    start, _ = camera.project(before.inverse.apply(point))
    end, _ = camera.project(after.inverse.apply(point))
    return np.asarray(end - start)


def _typical_depth(depth: Float32) -> float:
    coarse = depth[::16, ::16]
    hit = coarse[coarse > 0]
    return float(np.median(hit)) if hit.size else 1000.0


class FrameLog:
    """``frames.csv``: the true camera pose of every exposed frame, also as ``truth.tum``."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("w", newline="", encoding="utf-8")
        self._tum = path.with_name("truth.tum").open("w", encoding="utf-8")
        self._writer = csv.writer(self._file)
        self._writer.writerow(FRAME_COLUMNS)

    def add(
        self, sequence: int, time_ns: int, world_from_camera: Pose, true_ns: int | None = None
    ) -> None:
        """Append one frame; it is on disk when this returns. time_ns: by the stream, used to match
        estimates; true_ns: exposure time; None: time_ns.
        """
        t, q = world_from_camera.translation, quaternion_from_matrix(world_from_camera.rotation)
        row = (time_ns, sequence, *(f"{x:.5f}" for x in t), *(f"{x:.9f}" for x in q))
        row = (*row, time_ns if true_ns is None else true_ns)
        self._writer.writerow(row)
        self._file.flush()
        self._tum.write(tum_line(StampedPose("", world_from_camera, time_ns)) + "\n")
        self._tum.flush()

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        self._tum.close()
