import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.synth.heightfield.render import render
from localizer.synth.heightfield.scene import Land, LitScene, Prism, SkyLight, compose, light_scene

N, CELL = 128, 0.5
NADIR = np.diag([1.0, -1.0, -1.0])
NOON = SkyLight((0.0, 0.0, 1.0), 0.7, 0.3)


def land(height: np.ndarray | None = None) -> Land:
    z = np.zeros((N, N), np.float32) if height is None else height.astype(np.float32)
    return Land(z, np.full((N, N, 3), 0.5, np.float32), CELL)


def lit(prisms: list[Prism], light: SkyLight = NOON) -> LitScene:
    return light_scene(compose(land(), prisms), light, (0.5, 0.6, 0.7))


def house(height: float = 10.0, ridge: float = 0.0) -> Prism:
    corners = np.array([[40, 40], [80, 40], [80, 70], [40, 70]], np.float32)
    return Prism(corners, height, ridge, (0.8, 0.1, 0.1), (0.2, 0.2, 0.8), 3.0)


def test_depth_over_flat_ground_is_the_height() -> None:
    camera = Camera.from_fov(64, 48, 60)
    depth = render(lit([]), Pose(NADIR, np.array([32.0, 32.0, 50.0])), camera)[1]
    np.testing.assert_allclose(depth, 50.0, atol=0.02)


def test_depth_of_an_oblique_view_is_on_the_plane() -> None:
    camera = Camera.from_fov(64, 48, 50)
    c, s = np.cos(np.radians(40)), np.sin(np.radians(40))
    rotation = np.array([[1, 0, 0], [0, -s, c], [0, -c, -s]])
    pose = Pose(rotation, np.array([30.0, 5.0, 40.0]))
    depth = render(lit([]), pose, camera)[1]
    v, u = np.mgrid[0:48, 0:64] + 0.5
    points = pose.apply(camera.rays(np.stack([u, v], -1)) * depth[..., None])
    np.testing.assert_allclose(points[..., 2], 0.0, atol=0.02)


def test_a_building_stands_up_and_has_its_colours() -> None:
    camera = Camera.from_fov(96, 96, 40)
    image, depth = render(lit([house()]), Pose(NADIR, np.array([30.0, 27.5, 70.0])), camera)
    assert depth[48, 48] == pytest.approx(60.0, abs=0.05)
    assert image[48, 48, 0] > 2 * image[48, 48, 2]
    c, s = np.cos(np.radians(25)), np.sin(np.radians(25))
    oblique = Pose(np.array([[1, 0, 0], [0, -s, c], [0, -c, -s]]), np.array([30.0, -15.0, 20.0]))
    wall = render(lit([house()]), oblique, camera)[0].reshape(-1, 3).astype(int)
    assert (wall[:, 2] > 2 * wall[:, 0]).sum() > 200


def test_shadows_fall_away_from_the_sun() -> None:
    sun = SkyLight((np.cos(np.radians(30)), 0.0, np.sin(np.radians(30))), 1.0, 0.3)
    camera = Camera.from_fov(128, 128, 60)
    # Columns grow with x: the sun stands in the east, so the shadow is west of the house.
    pose = Pose(NADIR, np.array([30.0, 27.5, 60.0]))
    image = render(lit([house()], sun), pose, camera)[0].astype(int).sum(-1)
    middle = 64
    west, east = image[middle, 20:30].mean(), image[middle, 100:108].mean()
    assert west < 0.7 * east
