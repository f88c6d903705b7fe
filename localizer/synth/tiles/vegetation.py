"""What is small: trees and hedges as crowns painted from above; cars and people of fixed shape."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.synth.buildings.shell import LEAF, MID, TOP
from localizer.synth.config import SURVEY, VisitLook
from localizer.synth.paint.covers import WindowLight, as_byte, new_image, noise
from localizer.synth.plan.planner import Hedge, Trees
from localizer.synth.tiles.charts import ChartedMesh
from localizer.types import Image


@njit(cache=True, nogil=True, fastmath=True)
def paint_crown(base, conifer, seed, shade, sun, sun_rgb, sky_rgb, out):  # type: ignore[no-untyped-def]
    """Paint a crown seen from above into out (n, n, 3): about the trunk, edge = underside."""
    n = out.shape[0]
    half = n / 2
    for i in range(n):
        dy = (half - i - 0.5) / half
        for j in range(n):
            dx = (j + 0.5 - half) / half
            radius = np.sqrt(dx * dx + dy * dy)
            tilt = min(radius, 1.0) * (1.15 if conifer else 1.75)
            inverse = np.sin(tilt) / max(radius, 1e-6)
            nx, ny, nz = dx * inverse, dy * inverse, np.cos(tilt)
            if conifer:
                angle = np.arctan2(dy, dx)
                clump = 0.30 * np.sin(radius * 19 + 2.2 * noise(angle * 2.5, radius * 3, seed))
                clump += 0.5 * noise(angle * 6, radius * 7, seed + 1)
            else:
                clump = 0.75 * noise(dx * 4.2, dy * 4.2, seed)
                clump += 0.55 * noise(dx * 9.5, dy * 9.5, seed + 1)
            fine = noise(dx * 0.45 * n, dy * 0.45 * n, seed + 2)
            nx += 0.7 * noise(dx * 5 + 9, dy * 5, seed + 4)
            ny += 0.7 * noise(dx * 5, dy * 5 + 9, seed + 5)
            cosine = max(0.0, (nx * sun[0] + ny * sun[1] + nz * sun[2]) / 1.1)
            gap = 1.0
            if clump + 0.5 * fine < -0.38:
                gap = 0.5
            value = (1 + 0.55 * clump + 0.5 * fine) * gap
            sky = 0.55 + 0.45 * max(0.0, nz)
            hue = noise(dx * 2.1, dy * 2.1, seed + 6)
            for c in range(3):
                light = sky_rgb[c] * sky + sun_rgb[c] * (cosine * (1 - shade) + 0.08)
                tone = base[c] * (1 + (0.2 * hue if c == 0 else (0.05 * hue if c == 1 else 0)))
                out[i, j, c] = as_byte(tone * value * light)


_VARIANTS = 14  # crown textures of a tile
_CROWN_PX = 60

_LEAVES = np.array([(86, 108, 54), (98, 112, 60), (74, 98, 50), (106, 118, 66), (88, 102, 66)])
_AUTUMN = np.array([(150, 112, 48), (140, 84, 44), (158, 134, 62), (112, 104, 52), (128, 72, 44)])
_NEEDLES = np.array([(54, 74, 48), (62, 80, 56), (48, 66, 46)])


def _rings(profile: list[tuple[float, float]], sides: int) -> tuple[Array, NDArray[np.int64]]:
    """A crown of unit radius and height: vertices (V, 3) from the apex down, faces (F, 3).

    profile: (radius, height) of each ring below the apex.
    """
    vertices = [(0.0, 0.0, 1.0)]
    for k, (radius, height) in enumerate(profile):
        turn = (np.arange(sides) + 0.5 * (k % 2)) * 2 * np.pi / sides
        vertices += [(radius * np.cos(a), radius * np.sin(a), height) for a in turn]
    faces = [(0, 1 + k, 1 + (k + 1) % sides) for k in range(sides)]
    for ring in range(len(profile) - 1):
        a0, b0 = 1 + ring * sides, 1 + (ring + 1) * sides
        for k in range(sides):
            m = (k + 1) % sides
            if ring % 2 == 0:  # the lower ring is turned half a step on
                faces += [(a0 + k, b0 + k, a0 + m), (a0 + m, b0 + k, b0 + m)]
            else:
                faces += [(a0 + k, b0 + k, b0 + m), (a0 + k, b0 + m, a0 + m)]
    return np.array(vertices), np.array(faces, np.int64)


# (species is conifer, dense, level bits) -> crown
_ROUND = _rings([(0.62, 0.86), (1.0, 0.56), (0.72, 0.22)], 7)
_DOME = _rings([(0.66, 0.82), (1.0, 0.40)], 6)
_SPIRE = _rings([(0.42, 0.55), (1.0, 0.10)], 6)
_BLOB = _rings([(0.95, 0.45)], 5)


def crown_images(rng: np.random.Generator, look: VisitLook, light: WindowLight) -> list[Image]:
    """Crown textures: broadleaf in light and in shade, then conifers in light and in shade."""
    images = []
    for conifer in (False, True):
        for shade in (0.0, 0.75):
            for _ in range(_VARIANTS // 2):
                if conifer:
                    base = _NEEDLES[rng.integers(len(_NEEDLES))].astype(float)
                else:
                    turn = np.clip(2 * look.leaf - 0.75 + rng.normal(0, 0.22), 0, 1)
                    k = rng.integers(len(_LEAVES))
                    base = (1 - turn) * _LEAVES[k] + turn * _AUTUMN[k]
                base = base * rng.normal(1.0, 0.09)
                out = new_image(_CROWN_PX, _CROWN_PX)
                paint_crown(base, conifer, int(rng.integers(1 << 20)), shade, light.sun,
                            light.sun_rgb, light.sky_rgb, out)  # fmt: skip
                images.append(out)
    return images


def crown_template(conifer: bool, dense: bool, level: int) -> tuple[Array, NDArray[np.int64]]:
    """The crown mesh of unit size for a level of detail."""
    if level == TOP:
        return _BLOB
    if conifer:
        return _SPIRE
    return _DOME if dense or level == MID else _ROUND


def tree_meshes(
    trees: Trees, chosen: NDArray[np.intp], ground_z: Array, shaded: NDArray[np.bool_],
    charts: list[Image], levels: tuple[int, ...] = (LEAF, MID, TOP),
) -> ChartedMesh:  # fmt: skip
    """Crowns of the chosen trees, each with its ground_z (m) and whether it is shaded. charts: of
    `crown_images`.
    """
    parts = []
    half = _VARIANTS // 2
    small = trees.species[chosen] == 2
    for level in levels:
        for conifer in (False, True):
            for dense in (False, True):
                pick = ((trees.species[chosen] == 1) == conifer) & (trees.dense[chosen] == dense)
                if level == TOP:
                    pick &= ~small
                if not pick.any():
                    continue
                index = chosen[pick]
                vertices, faces = crown_template(conifer, dense, level)
                n, m = len(index), len(vertices)
                seeds = trees.seed[index]
                wobble = np.sin(seeds[:, None] * 0.7391 + np.arange(m) * 2.3)
                bumps = (1.0 + 0.14 * wobble)[..., None]
                squash = 1 + 0.16 * np.sin(seeds * 1.31)[:, None]
                xyz = np.empty((n, m, 3))
                radius = trees.radius[index][:, None]
                local = vertices[None, :, :2] * bumps
                xyz[..., 0] = trees.xy[index, 0][:, None] + local[..., 0] * radius * squash
                xyz[..., 1] = trees.xy[index, 1][:, None] + local[..., 1] * radius / squash
                xyz[..., 2] = (
                    ground_z[pick][:, None] + vertices[None, :, 2] * (trees.height[index][:, None])
                )
                # Azimuthal texture: the lowest ring lies on the rim of the disc.
                reach = np.linalg.norm(vertices[:, :2], axis=1)
                below = vertices[:, 2] < 0.3  # the underside folds out to the rim
                rim = np.where(below & ~conifer, 0.97, reach * 0.82)[:, None]
                direction = vertices[:, :2] / np.maximum(reach, 1e-9)[:, None]
                disc = direction * rim * [1, -1] * 0.5 + 0.5
                st = np.broadcast_to(disc * _CROWN_PX, (n, m, 2))
                kind = conifer * 2 * half + shaded[pick] * half + seeds % half
                parts.append(
                    ChartedMesh(
                        xyz.reshape(-1, 3),
                        np.repeat(kind.astype(np.int64), m),
                        st.reshape(-1, 2).copy(),
                        (faces[None] + (np.arange(n) * m)[:, None, None]).reshape(-1, 3),
                        np.full(n * len(faces), level, np.uint8),
                        (),
                    )
                )
    merged = ChartedMesh.merged(parts)
    return ChartedMesh(
        merged.positions, merged.chart, merged.st, merged.faces, merged.levels, tuple(charts)
    )


def hedge_corners(hedge: Hedge, za: float, zb: float) -> list[Array]:
    """The hedge's top and four sides as quads (4, 3), counter-clockwise from outside.

    za, zb: height of the ground at its ends `a` and `b`, metres.
    """
    along = (hedge.b - hedge.a) / max(float(np.linalg.norm(hedge.b - hedge.a)), 1e-9)
    across = np.array([-along[1], along[0]]) * hedge.width / 2
    ring = [hedge.a - across, hedge.b - across, hedge.b + across, hedge.a + across]
    z = [za, zb, zb, za]
    top = np.array([[*p, h + hedge.height] for p, h in zip(ring, z, strict=True)])
    foot = np.array([[*p, h - 0.4] for p, h in zip(ring, z, strict=True)])
    quads = [top]
    for k in range(4):
        m = (k + 1) % 4
        quads.append(np.array([foot[k], foot[m], top[m], top[k]]))
    return quads


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
