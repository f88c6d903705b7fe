"""Trees and hedges as low-poly crowns whose texture is painted as seen from above."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.buildings.model import LEAF, MID, TOP
from localizer.synth.config import VisitLook
from localizer.synth.paint.covers import WindowLight, new_image
from localizer.synth.paint.crowns import paint_crown
from localizer.synth.plan.plan import Hedge, Trees
from localizer.synth.tiles.charts import ChartedMesh
from localizer.types import Image

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
