"""Small things of fixed shape: cars and people, as meshes with their own small texture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.synth.config import SURVEY, VisitLook
from localizer.types import Image

CAR_LENGTH_M, CAR_WIDTH_M, CAR_HEIGHT_M = 4.5, 1.84, 1.5
_PERSON_M = 1.75
_PX_PER_M = 16
_SIDE_ROW_M = 2.0  # texture rows: top view first, then the side view from here

CAR_COLOURS: tuple[tuple[int, int, int], ...] = (
    (206, 206, 204), (228, 228, 226), (62, 64, 68), (36, 38, 42), (120, 124, 128), (148, 150, 150),
    (132, 36, 34), (44, 70, 118), (70, 86, 78), (168, 148, 112), (196, 60, 44), (30, 52, 84),
)  # fmt: skip


@dataclass(frozen=True)
class PropShape:
    """positions (V, 3) float64 metres: x forward, y left, z up, origin on the ground; st (V, 2)
    metres in the texture (s right, t down); faces (F, 3) int32; normals (F, 3) float64.
    """

    positions: Array
    st: Array
    faces: NDArray[np.int32]
    normals: Array


def _shape(quads: list[tuple[list[tuple[float, float, float]], str]]) -> PropShape:
    """Quads seen counter-clockwise from outside; 'top' and 'side' choose the projection."""
    positions: list[tuple[float, float, float]] = []
    st: list[tuple[float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for points, view in quads:
        k = len(positions)
        for x, y, z in points:
            positions.append((x, y, z))
            s = x + CAR_LENGTH_M / 2
            if view == "top":
                st.append((s, CAR_WIDTH_M / 2 - y))
            elif view == "side":
                st.append((s, _SIDE_ROW_M + CAR_HEIGHT_M - z))
            else:  # front or back: the bumper's colour, a column of the side view
                st.append((0.15 if x < 0 else CAR_LENGTH_M - 0.15, _SIDE_ROW_M + CAR_HEIGHT_M - z))
        faces += [(k, k + 1, k + 2), (k, k + 2, k + 3)]
    p, f = np.array(positions), np.array(faces, np.int32)
    normals = np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PropShape(p, np.array(st), f, normals)


def car_shape() -> PropShape:
    """A saloon: body, bonnet, boot and glasshouse."""
    a, w, belt, roof = CAR_LENGTH_M / 2, CAR_WIDTH_M / 2, 0.92, CAR_HEIGHT_M
    low, c = 0.22, w - 0.16
    front, back, f2, b2 = 0.95, -1.85, 0.25, -1.25  # glasshouse at the belt and at the roof
    quads: list[tuple[list[tuple[float, float, float]], str]] = [
        ([(-a, -w, low), (a, -w, low), (a, -w, belt - 0.14), (-a, -w, belt - 0.08)], "side"),
        ([(a, w, low), (-a, w, low), (-a, w, belt - 0.08), (a, w, belt - 0.14)], "side"),
        ([(a, -w, low), (a, w, low), (a, w, belt - 0.14), (a, -w, belt - 0.14)], "end"),
        ([(-a, w, low), (-a, -w, low), (-a, -w, belt - 0.08), (-a, w, belt - 0.08)], "end"),
        ([(-a, -w, belt - 0.08), (a, -w, belt - 0.14), (a, w, belt - 0.14), (-a, w, belt - 0.08)],
         "top"),
        ([(back, -w, belt - 0.1), (front, -w, belt - 0.1), (f2, -c, roof), (b2, -c, roof)], "side"),
        ([(front, w, belt - 0.1), (back, w, belt - 0.1), (b2, c, roof), (f2, c, roof)], "side"),
        ([(front, -w, belt - 0.1), (front, w, belt - 0.1), (f2, c, roof), (f2, -c, roof)], "top"),
        ([(back, w, belt - 0.1), (back, -w, belt - 0.1), (b2, -c, roof), (b2, c, roof)], "top"),
        ([(b2, -c, roof), (f2, -c, roof), (f2, c, roof), (b2, c, roof)], "top"),
    ]  # fmt: skip
    return _shape(quads)


def car_image(colour: tuple[int, int, int], seed: int, look: VisitLook = SURVEY) -> Image:
    """Top and side view of a car as one texture, (64, 72, 3) uint8, with even light from above.
    colour: of the paint, RGB; seed: of the details; look: light of the visit.
    """
    rng = np.random.default_rng([seed, 5])
    height, width = round(4.0 * _PX_PER_M), round(CAR_LENGTH_M * _PX_PER_M)
    light = np.array(look.sky_rgb) + np.array(look.sun_rgb) * look.sun_direction[2]
    image = np.empty((height, width, 3), np.float32)
    image[:] = np.array(colour) * light

    def box(s0: float, s1: float, t0: float, t1: float, value: tuple[float, ...]) -> None:
        u0, u1, v0, v1 = (round(k * _PX_PER_M) for k in (s0, s1, t0, t1))
        image[v0:v1, u0:u1] = value

    a, m = CAR_LENGTH_M / 2, CAR_WIDTH_M / 2
    dark = (34.0, 40.0, 46.0)
    box(a + 0.3, a + 0.92, 0.14, 2 * m - 0.14, dark)  # windscreen
    box(a - 1.82, a - 1.28, 0.18, 2 * m - 0.18, dark)  # rear window
    box(a - 1.2, a + 0.22, 0.1, 0.17, dark)
    box(a - 1.2, a + 0.22, 2 * m - 0.17, 2 * m - 0.1, dark)
    if rng.random() < 0.3:
        box(a - 0.9, a - 0.1, 0.45, 2 * m - 0.45, (50.0, 56.0, 62.0))  # sunroof
    image[: round(2 * m * _PX_PER_M), round((a + 1.6) * _PX_PER_M) :] *= 0.94
    side = _SIDE_ROW_M
    image[round(side * _PX_PER_M) :] *= 0.72
    box(a - 1.7, a + 0.85, side + 0.12, side + 0.58, dark)
    for s in (0.85, CAR_LENGTH_M - 0.95):
        centre = (round(s * _PX_PER_M), round((side + 1.2) * _PX_PER_M))
        cv2.circle(image, centre, round(0.32 * _PX_PER_M), (22, 22, 24), -1)
    image += rng.normal(0, 5, image.shape)
    return np.asarray(np.clip(image, 0, 255), np.uint8)


def _tile_mesh(shape: PropShape, image: Image) -> TileMesh:
    size = np.array([image.shape[1], image.shape[0]]) / _PX_PER_M
    return TileMesh(
        positions=shape.positions.astype(np.float32),
        uvs=(shape.st / size).astype(np.float32),
        faces=shape.faces,
        mips=build_mips(image),
        world_from_tile=Pose.identity(),
    )


def car_mesh(colour: tuple[int, int, int] | None = None, seed: int = 0) -> TileMesh:
    """A car, x forward, z up, origin on the ground below its middle; colour: RGB, None: by seed."""
    chosen = CAR_COLOURS[seed % len(CAR_COLOURS)] if colour is None else colour
    return _tile_mesh(car_shape(), car_image(chosen, seed))


def person_mesh(clothes: tuple[int, int, int]) -> TileMesh:
    """A standing person: a faceted body of legs, torso and head, origin between the feet."""
    sides = 6
    #        z as a share of height, half depth, half width, colour row
    rings = [(0.0, 0.10, 0.14, 0.05), (0.48, 0.12, 0.18, 0.45), (0.50, 0.13, 0.20, 0.55),
             (0.80, 0.14, 0.24, 0.70), (0.84, 0.07, 0.08, 0.78), (0.87, 0.10, 0.09, 0.85),
             (0.98, 0.10, 0.09, 0.95)]  # fmt: skip
    turn = np.arange(sides) * 2 * np.pi / sides
    positions, uvs, faces = [], [], []
    for z, depth, width, row in rings:
        for angle in turn:
            positions.append((depth * np.cos(angle), width * np.sin(angle), z * _PERSON_M))
            uvs.append((0.1 + 0.8 * (0.5 + 0.5 * np.cos(angle)), row))
    for ring in range(len(rings) - 1):
        for k in range(sides):
            a, b = ring * sides + k, ring * sides + (k + 1) % sides
            faces += [(a, b, b + sides), (a, b + sides, a + sides)]
    positions.append((0.0, 0.0, _PERSON_M))
    uvs.append((0.5, 0.97))
    last = (len(rings) - 1) * sides
    faces += [(last + k, last + (k + 1) % sides, len(positions) - 1) for k in range(sides)]
    image = np.empty((32, 8, 3), np.uint8)
    image[:16], image[16:24], image[24:29] = (52, 52, 58), clothes, (196, 152, 124)
    image[29:] = (70, 52, 40)
    image[:, :4] = (image[:, :4] * 0.85).astype(np.uint8)
    return TileMesh(
        positions=np.array(positions, np.float32),
        uvs=np.array(uvs, np.float32),
        faces=np.array(faces, np.int32),
        mips=build_mips(image),
        world_from_tile=Pose.identity(),
    )
