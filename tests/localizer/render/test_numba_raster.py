"""The CPU renderer against analytic rays, near-plane clipping, textures, ownership of results."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from localizer.errors import CameraError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.pick import cast_rays
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.render.base import NEAR_M
from localizer.render.numba_raster import NumbaRenderer

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


def mesh_of(positions, faces, image=None, uvs=None, pose=None, repeat=False) -> TileMesh:
    image = np.full((8, 8, 3), 255, np.uint8) if image is None else image
    uvs = np.zeros((len(positions), 2)) if uvs is None else uvs
    return TileMesh(
        np.asarray(positions, np.float32),
        np.asarray(uvs, np.float32),
        np.asarray(faces, np.int32),
        build_mips(image),
        pose or Pose.identity(),
        repeat,
    )


def quad(size, z=0.0, **options) -> TileMesh:
    """A square about the origin, uv (0, 0) at its north-west corner."""
    s = size / 2
    positions = [[-s, s, z], [s, s, z], [-s, -s, z], [s, -s, z]]
    uvs = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * options.pop("tiles", 1)
    return mesh_of(positions, [[0, 2, 1], [1, 2, 3]], uvs=uvs, **options)


def town(seed: int, pose: Pose) -> TileMesh:
    """Random ground and boxes, not consistently wound."""
    rng = np.random.default_rng(seed)
    n = 24
    s = np.linspace(-120, 120, n)
    x, y = np.meshgrid(s, s)
    ground = np.stack([x, y, rng.normal(0, 1.5, x.shape)], -1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = [np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + n, i + n + 1], 1)]
    positions = [ground]
    count = len(ground)
    for _ in range(30):
        low = np.r_[rng.uniform(-110, 90, 2), -3]
        high = low + np.r_[rng.uniform(5, 20, 2), rng.uniform(8, 35)]
        corners = np.array([[(high if k >> a & 1 else low)[a] for a in range(3)] for k in range(8)])
        sides = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
        for a, b, c, d in sides:
            faces.append(np.array([[a, b, c], [a, c, d]]) + count)
        positions.append(corners)
        count += 8
    return mesh_of(np.concatenate(positions), np.concatenate(faces), pose=pose)


@pytest.fixture(scope="module")
def renderer():
    """Of two threads; the parity tests draw with one."""
    streamer = SimpleNamespace(select=lambda pose, camera, wait: [])
    r = NumbaRenderer(streamer, threads=2)
    yield r
    r.close()


def analytic(mesh: TileMesh, pose: Pose, camera: Camera) -> np.ndarray:
    """Depth by intersecting every pixel's ray with every triangle, in float64 numpy."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = camera.rays(np.stack([u, v], -1).reshape(-1, 2))
    local = (pose.inverse @ mesh.world_from_tile).apply(mesh.positions)[mesh.faces]
    depth = np.full(len(rays), np.inf)
    for a, b, c in local:
        normal = np.cross(b - a, c - a)
        facing = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (a @ normal) / facing
        points = rays * z[:, None]
        inside = np.ones(len(rays), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            inside &= np.cross(q - p, points - p) @ normal >= 0
        hit = inside & (z > NEAR_M)
        depth[hit] = np.minimum(depth[hit], z[hit])
    return np.where(np.isfinite(depth), depth, 0).reshape(camera.height, camera.width)


POSES = [
    Pose(DOWN, np.array([3.0, -4.0, 90.0])),
    Pose(so3_exp([0.9, 0.1, 0.2]) @ DOWN, np.array([0.0, -80.0, 60.0])),
    Pose(so3_exp([1.4, 0.0, -0.5]) @ DOWN, np.array([10.0, -30.0, 12.0])),
]


@pytest.mark.parametrize("pose", POSES)
def test_rays_cast_at_triangles_agree_with_analytic_ones(pose):
    mesh = town(2, Pose(so3_exp([0.0, 0.0, 1.0]), np.array([200.0, 100.0, 0.0])))
    view = mesh.world_from_tile @ pose
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    v, u = np.mgrid[0:48, 0:64] + 0.5
    rays = camera.rays(np.stack([u, v], -1).reshape(-1, 2))
    z = cast_rays([mesh], view.translation, rays @ view.rotation.T)
    truth = analytic(mesh, view, camera).ravel()
    # Rays that start nearer than the near plane hit what the renderer cuts off.
    far = ~(z < NEAR_M)
    assert np.array_equal(np.isfinite(z)[far], (truth > 0)[far])
    assert np.abs(z - truth)[far & np.isfinite(z)].max() < 1e-5


def test_pixel_centres_are_at_one_half(renderer):
    # A plane z = x (camera at the origin, looking along x): depth reveals where the ray went.
    camera = Camera(16, 16, 8.0, 8.0, 8.0, 8.0)
    pose = Pose(DOWN, np.array([0.0, 0.0, 10.0]))
    s = 200.0
    slope = mesh_of(
        [[-s, -s, -s / 2], [s, -s, s / 2], [-s, s, -s / 2], [s, s, s / 2]], [[0, 1, 2], [1, 3, 2]]
    )
    depth = renderer.draw([slope], pose, camera).depth
    for column in (0, 5, 15):
        slope_x = (column + 0.5 - 8.0) / 8.0
        expected = 10.0 / (1 + 0.5 * slope_x)
        assert depth[3, column] == pytest.approx(expected, rel=1e-5)


def test_triangles_across_the_near_plane_are_cut(renderer):
    # The camera skims over a huge two-triangle ground: both reach behind it.
    camera = Camera(64, 64, 40.0, 40.0, 32.0, 32.0)
    north = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    view = Pose(north, np.array([0.0, 0.0, 2.0]))
    depth = renderer.draw([quad(4000.0)], view, camera).depth
    rows = np.arange(40, 64)
    expected = 2.0 / ((rows + 0.5 - 32) / 40)
    assert np.abs(depth[40:, 20] / expected - 1).max() < 1e-4
    assert (depth[:32] == 0).all()


def test_neighbouring_triangles_leave_no_cracks(renderer):
    rng = np.random.default_rng(5)
    n = 150
    s = np.linspace(-60, 60, n)
    x, y = np.meshgrid(s, s)
    points = np.stack([x, y, rng.normal(0, 0.3, x.shape)], -1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + n, i + n + 1], 1)])
    mesh = mesh_of(points, faces)
    camera = Camera.from_fov(320, 240, 60)
    for k in range(4):
        view = Pose(so3_exp([0.1 * k, 0.05, 0.3 * k]) @ DOWN, np.array([0.37, -0.21, 40.0]))
        assert (renderer.draw([mesh], view, camera).depth > 0).all()


def test_both_sides_are_drawn_and_the_nearest_wins(renderer):
    camera = Camera.from_fov(64, 64, 60)
    view = Pose(DOWN, np.array([0.0, 0.0, 50.0]))
    low, high = quad(100.0), quad(10.0, z=5.0)
    flipped = mesh_of(high.positions, high.faces[:, ::-1])
    for meshes in ([low, high], [high, low], [low, flipped]):
        depth = renderer.draw(meshes, view, camera).depth
        assert depth[32, 32] == pytest.approx(45, rel=1e-5)
        assert depth[2, 2] == pytest.approx(50, rel=1e-5)


def colours(size=64):
    """Red grows to the east, green to the south."""
    ramp = np.linspace(0, 255, size)
    image = np.zeros((size, size, 3), np.uint8)
    image[..., 0], image[..., 1] = ramp[None], ramp[:, None]
    image[..., 2] = 77
    return image


def test_texture_lies_as_the_coordinates_say(renderer):
    image = colours()
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0)
    view = Pose(DOWN, np.array([0.0, 0.0, 64.0]))  # one texel per pixel
    rgb = renderer.draw([quad(64.0, image=image)], view, camera).rgb
    assert np.abs(rgb.astype(int) - image).max() <= 1


def test_oblique_texture_is_perspective_correct(renderer):
    image = colours(256)
    camera = Camera(160, 120, 140.0, 140.0, 80.0, 60.0)
    view = Pose(so3_exp([0.7, 0.0, 0.4]) @ DOWN, np.array([-30.0, -40.0, 60.0]))
    drawn = renderer.draw([quad(400.0, image=image)], view, camera)
    pixels = np.array([[20.5, 30.5], [80.5, 100.5], [140.5, 60.5]])
    depth = drawn.depth[[30, 100, 60], [20, 80, 140], None]
    points = view.apply(camera.rays(pixels) * depth)
    expected = np.stack([points[:, 0] + 200, 200 - points[:, 1]], -1) / 400 * 255
    got = drawn.rgb[[30, 100, 60], [20, 80, 140], :2]
    assert np.abs(got - expected).max() < 3


def test_far_textures_are_averaged_not_sampled(renderer):
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 2, (512, 512, 1), dtype=np.uint8).repeat(3, axis=2) * 255
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0)
    near = renderer.draw([quad(512.0, image=noise)], Pose(DOWN, np.array([0, 0, 64.0])), camera)
    far = renderer.draw([quad(512.0, image=noise)], Pose(DOWN, np.array([0, 0, 512.0])), camera)
    assert near.rgb.std() > 100
    assert far.rgb.std() < 30
    assert far.rgb.mean() == pytest.approx(127, abs=6)


def test_repeated_textures_wrap(renderer):
    image = colours(32)
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0)
    view = Pose(DOWN, np.array([0.0, 0.0, 64.0]))
    rgb = renderer.draw([quad(64.0, image=image, tiles=2, repeat=True)], view, camera).rgb
    assert np.abs(rgb[2:30, 2:30].astype(int) - rgb[34:62, 34:62]).max() <= 1
    assert rgb[16, 8, 0] == pytest.approx(image[16, 8, 0], abs=6)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
@pytest.mark.parametrize("value", [1e12, 1e39, np.nan])
def test_a_pose_beyond_all_measure_shows_nothing_and_harms_nothing(renderer, value):
    """float32 overflows there, and compiled loops do not check their indices."""
    mesh = quad(10.0, 5.0)
    with np.errstate(all="ignore"):
        for pose in (
            Pose(np.eye(3), np.array([value, 0.0, 0.0])),
            Pose(np.eye(3) * value, np.zeros(3)),
        ):
            view = renderer.draw([mesh], pose, Camera.from_fov(64, 48, 60.0))
            assert not (view.depth > 0).any()


def test_distorted_cameras_are_refused(renderer):
    camera = Camera(64, 64, 60.0, 60.0, 32.0, 32.0, (0.1, 0, 0, 0, 0))
    with pytest.raises(CameraError, match="pinhole"):
        renderer.render(Pose.identity(), camera)
