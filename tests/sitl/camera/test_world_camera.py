"""The world camera's pictures against projections worked out by OpenCV, and its sequences."""

from __future__ import annotations

import json
import socket
from collections import Counter
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.geometry import GimbalAngles, Mount, camera_attitude, world_from_camera
from companion.offline.record import poses, read_columns
from companion.sources import open_source
from companion.sources.zoom import ZoomTable, with_focal_factor
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, matrix_from_euler, matrix_from_quaternion, so3_exp
from localizer.geometry.trajectory import read_poses, read_tum
from localizer.geometry.trajectory import world_from_camera as pose_of_row
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import Appearance
from sitl.camera.detector import Detector, DetectorErrors, DetectorView, FixedPoint
from sitl.camera.movers import Mover
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import CameraOptions, FrameLog, RenderedLens, WorldCamera, centre_flow
from sitl.camera.zoom import Zooming, ZoomLens, level_of
from sitl.demo.kinematic import record_sequence
from sitl.suite.loop.case import load_loop_cases

CAMERA = Camera(320, 240, 230.0, 232.0, 163.0, 118.0, (-0.12, 0.03, 0.002, -0.001, -0.004))
HALF_M = 200.0
PX_PER_M = 4
SPOTS = np.array(
    [[0, 0], [12, 20], [-35, 28], [40, -25], [-30, -28], [52, 36]], float
)  # east, north


class _Still:
    """A streamer that always gives the same meshes."""

    def __init__(self, *meshes: TileMesh) -> None:
        self._meshes = list(meshes)

    def select(self, *_: object, wait: bool = False) -> list[TileMesh]:
        return self._meshes


def _ground() -> TileMesh:
    """Flat dark ground at height 0 with a white spot of 1.5 m at each of SPOTS."""
    size = int(2 * HALF_M * PX_PER_M)
    texture = np.full((size, size, 3), 40, np.uint8)
    for east, north in SPOTS:
        centre = np.array([east + HALF_M, HALF_M - north]) * PX_PER_M - 0.5
        cv2.circle(texture, np.rint(centre * 16).astype(int).tolist(), int(0.75 * PX_PER_M * 16),
                   (250, 250, 250), -1, cv2.LINE_AA, 4)  # fmt: skip
    h = HALF_M
    corners = np.array([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]], np.float32)
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TileMesh(corners, uvs, faces, build_mips(texture), Pose.identity())


@pytest.fixture(scope="module")
def renderer() -> NumbaRenderer:
    return NumbaRenderer(_Still(_ground()), threads=1)  # type: ignore[arg-type]


def _pose(yaw_deg: float = 30.0, pitch_deg: float = -78.0) -> Pose:
    body = matrix_from_euler(0.05, -0.03, np.radians(yaw_deg))
    gimbal = GimbalAngles(0.0, np.radians(pitch_deg), 0.0)
    R = camera_attitude(body, gimbal, Mount.from_degrees())
    return world_from_camera((-4.0, -6.0, 90.0), body, R, (0.1, 0.0, 0.1))


def _track(*poses: Pose, step_ns: int = 100_000_000) -> PoseTrack:
    return PoseTrack((i * step_ns, p) for i, p in enumerate(poses))


def _opencv_pixels(points: np.ndarray, pose: Pose, camera: Camera) -> np.ndarray:
    """By cv2.projectPoints, moved from OpenCV's pixel centres to ours."""
    inverse = pose.inverse
    rotation, _ = cv2.Rodrigues(inverse.rotation)
    pixels, _ = cv2.projectPoints(
        points, rotation, inverse.translation, camera.K, np.array(camera.distortion)
    )
    return pixels[:, 0]  # with K in our convention the result is in it too


def _blob(image: np.ndarray, near: np.ndarray, radius: int = 7) -> np.ndarray:
    """Centroid (2,) of the bright spot near a pixel."""
    x, y = np.round(near).astype(int)
    window = image[y - radius : y + radius, x - radius : x + radius].mean(-1) - 60
    weight = np.clip(window, 0, None)
    v, u = np.mgrid[y - radius : y + radius, x - radius : x + radius] + 0.5
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


def test_spots_appear_where_opencv_projects_them(renderer: NumbaRenderer) -> None:
    pose = _pose()
    world_camera = WorldCamera(renderer, CAMERA, Appearance())
    exposure = world_camera.expose(0, _track(pose))
    assert exposure is not None
    points = np.column_stack([SPOTS, np.zeros(len(SPOTS))])
    expected = _opencv_pixels(points, pose, CAMERA)
    margin = np.all((expected > 10) & (expected < (310, 230)), axis=1)
    assert margin.sum() >= 4
    found = np.array([_blob(exposure.image, p) for p in expected[margin]])
    np.testing.assert_allclose(found, expected[margin], atol=0.15)
    # The lens matters: without it the outer spots would be pixels away.
    pinhole = _opencv_pixels(points, pose, CAMERA.without_distortion())
    assert np.abs(pinhole - expected)[margin].max() > 2.0


def test_the_rendered_pinhole_covers_the_distorted_picture() -> None:
    for k1 in (-0.2, 0.2):
        camera = Camera(320, 240, 230, 230, 150, 130, (k1, 0, 0, 0, 0))
        lens = RenderedLens.of(camera)
        white = np.full((lens.pinhole.height, lens.pinhole.width, 3), 255, np.uint8)
        assert lens.distort(white).min() == 255
        depth = np.full(white.shape[:2], 7.0, np.float32)
        assert lens.distort_depth(depth).min() == 7.0
    assert RenderedLens.of(Camera.from_fov(64, 48, 60)).pinhole.width == 66


def test_a_mover_is_drawn_at_its_true_place(renderer: NumbaRenderer) -> None:
    red = np.zeros((8, 8, 3), np.uint8)
    red[..., 0] = 255
    corners = np.array([[-3, -3, 0.2], [3, -3, 0.2], [3, 3, 0.2], [-3, 3, 0.2]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    square = TileMesh(corners, np.zeros((4, 2), np.float32), faces, (red,), Pose.identity())
    path = np.array([[-20.0, 10, 0], [20, 10, 0], [20, 14, 0], [-20, 14, 0]])
    mover = Mover("car", path, speed_mps=10.0, phase_m=0.0, mesh=square)
    camera = WorldCamera(renderer, CAMERA, Appearance(), CameraOptions((mover,)))
    track = PoseTrack([(0, _pose()), (10 * 10**9, _pose())])
    for time_ns in (500_000_000, 3_000_000_000):
        exposure = camera.expose(time_ns, track)
        image = exposure.image.astype(int)
        mask = (image[..., 0] > 150) & (image[..., 1] < 80)
        v, u = np.nonzero(mask)
        centre = mover.position_at(time_ns) + np.array([0, 0, 0.2])
        expected = _opencv_pixels(centre[None], exposure.world_from_camera, CAMERA)[0]
        np.testing.assert_allclose([u.mean() + 0.5, v.mean() + 0.5], expected, atol=0.5)


def test_the_blur_is_the_motion_during_the_shutter(renderer: NumbaRenderer) -> None:
    still = _pose()
    # 60 deg/s about the camera's y axis: 0.3 deg in 5 ms, along the image's x axis.
    turned = Pose(still.rotation @ so3_exp([0, np.radians(6.0), 0]), still.translation)
    flow = centre_flow(still, Pose(still.rotation @ so3_exp([0, np.radians(0.3), 0]),
                                   still.translation), CAMERA, 90.0)  # fmt: skip
    assert abs(flow[0]) == pytest.approx(230 * np.tan(np.radians(0.3)), rel=0.02)
    assert abs(flow[1]) < 0.01

    def sharpness(track: PoseTrack, shutter_s: float) -> float:
        camera = WorldCamera(renderer, CAMERA, Appearance(), CameraOptions(shutter_s=shutter_s))
        exposure = camera.expose(50_000_000, track)
        return float(np.abs(np.diff(exposure.image.astype(float), axis=1)).max())

    moving = _track(still, turned)
    assert sharpness(moving, 0.02) < 0.6 * sharpness(moving, 0.0)


def test_a_recorded_sequence_is_read_back_as_it_was(renderer, tmp_path):
    frame = LocalFrame(Geodetic(47.0, 8.0, 430.0))
    track = _track(_pose(30), _pose(33, -70), _pose(35, -60))
    camera = WorldCamera(renderer, CAMERA, Appearance(read_noise=0.01), CameraOptions(seed=4))
    times = [0, 70_000_000, 140_000_000, 999_000_000_000]
    assert record_sequence(camera, track, times, frame, tmp_path) == 3
    read_camera = Camera.from_json(tmp_path / "camera.json")
    assert read_camera == CAMERA
    frames = list(open_source(tmp_path / "images", read_camera).frames())
    assert [f.exposure_time_ns for f in frames] == times[:3]
    rows = read_poses(tmp_path / "poses.txt")
    assert [r.name for r in rows] == ["000000.jpg", "000001.jpg", "000002.jpg"]
    for row, time_ns in zip(rows, times, strict=False):
        true = track.at(time_ns)
        assert true is not None
        metres, degrees = pose_of_row(row, frame).distance_to(true)
        assert metres < 1e-3
        assert degrees < 1e-4


def test_the_frame_log_is_read_by_the_analysis(tmp_path: Path) -> None:
    pose = _pose()
    with closing(FrameLog(tmp_path / "frames.csv")) as log:
        log.add(0, 123_456_789_012_345_678, pose)
        log.add(1, 123_456_789_112_345_678, pose)
    columns = read_columns(tmp_path / "frames.csv")
    assert columns["exposure_time_ns"].tolist() == [
        123_456_789_012_345_678,
        123_456_789_112_345_678,
    ]
    metres, degrees = poses(columns)[1].distance_to(pose)
    assert metres < 1e-4
    assert degrees < 1e-5
    assert np.allclose(matrix_from_quaternion([columns[k][0] for k in ("qw", "qx", "qy", "qz")]),
                       pose.rotation, atol=1e-7)  # fmt: skip
    tum = read_tum(tmp_path / "truth.tum")
    assert [p.time_ns for p in tum] == columns["exposure_time_ns"].tolist()
    assert tum[1].world_from_camera.distance_to(pose)[0] < 1e-6


# --- zoom ---------------------------------------------------------------------------------------


CAMERA_ZOOM = Camera(160, 120, 150.0, 150.0, 78.0, 61.0, (-0.1, 0.02, 0.0, 0.0, 0.0))


def dot_at(image: np.ndarray) -> tuple[float, float]:
    """Centre of what is bright, with pixel centres at (u + 0.5, v + 0.5)."""
    weight = image[..., 0].astype(float)
    rows, columns = np.indices(weight.shape) + 0.5
    return float((columns * weight).sum() / weight.sum()), float(
        (rows * weight).sum() / weight.sum()
    )


@pytest.mark.parametrize("factor", [1.0, 1.2, 1.4])
def test_what_it_shows_lies_where_the_longer_camera_has_it(factor: float) -> None:
    point = np.array([0.15, -0.1, 1.0])
    image = np.zeros((120, 160, 3), np.uint8)
    pixel, _ = CAMERA_ZOOM.project(point)
    image[int(pixel[1]), int(pixel[0])] = 255
    ray = CAMERA_ZOOM.rays([int(pixel[0]) + 0.5, int(pixel[1]) + 0.5])
    lens = ZoomLens(CAMERA_ZOOM)
    lens.set(Zooming(1.0, factor, 0, 10))
    wanted, _ = with_focal_factor(CAMERA_ZOOM, factor).project(ray)
    assert dot_at(lens.apply(image, 20)) == pytest.approx(tuple(wanted), abs=0.3)


def test_it_moves_between_its_begin_and_its_end() -> None:
    zooming = Zooming(1.0, 1.4, 100, 200)
    assert [zooming.at(t) for t in (0, 150, 900)] == pytest.approx([1.0, 1.2, 1.4])
    assert level_of(zooming.at(900)) == pytest.approx(40.0)


def test_the_scenarios_table_is_near_the_lens_and_not_the_same() -> None:
    (case,) = load_loop_cases(["normal-zooms-told"])
    table = ZoomTable(points=case.zoom_points)
    off = [abs((table.factor(level_of(f)) or 0.0) / f - 1.0) for f in np.linspace(1.0, 2.0, 41)]
    assert 0.003 < max(off) < 0.007
    assert case.is_normal
    (unreported,) = load_loop_cases(["zooms-untold"])
    assert not unreported.is_normal
    assert unreported.needs_shadow_check


# --- The simulated operator's eye: what it can see, and the errors that it makes ----------------


CAMERA_DETECTOR = Camera.from_fov(320, 240, 60.0)
# 50 m up, looking down: x east, y south.
POSE = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 50.0]))
EXACT = DetectorErrors(noise_px=0.0)


@pytest.fixture
def listener():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        s.settimeout(2.0)
        yield s


def _eye(listener, targets, errors=EXACT):
    return Detector(
        f"127.0.0.1:{listener.getsockname()[1]}", CAMERA_DETECTOR, targets, errors, seed=1
    )


def _view(depth=50.0, time_ns=7, pose_of_row=lambda _: POSE):
    return DetectorView(time_ns, np.full((240, 320), depth, np.float32), pose_of_row)


def test_a_visible_target_is_sent_where_it_projects(listener):
    eye = _eye(listener, [FixedPoint("a", np.array([4.0, 3.0, 0.0]))])
    (seen,) = eye.observe(_view(), stamp_ns=11)
    pixel, _ = CAMERA_DETECTOR.project(POSE.inverse.apply(np.array([4.0, 3.0, 0.0])))
    assert (seen.u, seen.v) == pytest.approx(pixel)
    message = json.loads(listener.recv(2000))
    assert message["time_ns"] == 11  # of the frame in the stream, not of its exposure
    eye.close()


@pytest.mark.parametrize(
    ("place", "depth"),
    [
        ((4.0, 3.0, 0.0), 40.0),  # behind a roof 10 m above it
        ((400.0, 3.0, 0.0), 50.0),  # outside
        ((28.8, 0.0, 0.0), 50.0),  # on the very edge of the picture
        ((0.0, 0.0, 60.0), 50.0),  # above the camera
    ],
)
def test_what_nobody_could_see_is_not_reported(listener, place, depth):
    eye = _eye(listener, [FixedPoint("a", np.array(place))])
    assert eye.observe(_view(depth)) == []
    eye.close()


def test_misses_false_ones_and_exchanged_names_come_as_often_as_said(listener):
    places = {"a": np.array([4.0, 3.0, 0.0]), "b": np.array([-6.0, -5.0, 0.0])}
    errors = DetectorErrors(noise_px=0.0, missed=0.2, false=0.1, swapped=0.15)
    eye = _eye(listener, [FixedPoint(n, p) for n, p in places.items()], errors)
    true = {n: CAMERA_DETECTOR.project(POSE.inverse.apply(p))[0] for n, p in places.items()}
    count: Counter[str] = Counter()
    for _ in range(2000):
        for d in eye.observe(_view()):
            if d.target_id.startswith("no-target"):
                count["false"] += 1
                continue
            near = [n for n, p in true.items() if np.hypot(d.u - p[0], d.v - p[1]) < 0.01]
            count["right" if near == [d.target_id] else "swapped"] += 1
    seen = 2 * 2000 * 0.8
    assert count["false"] == pytest.approx(2000 * 0.1 * 0.96, rel=0.25)
    assert count["swapped"] == pytest.approx(2 * 2000 * 0.64 * 0.15, rel=0.25)
    assert count["right"] == pytest.approx(seen - count["swapped"], rel=0.08)
    eye.close()
