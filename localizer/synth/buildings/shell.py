"""Buildings: footprint, kind and surfaces, and the surfaces of one in its own frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from localizer.geometry.pose import Array
from localizer.synth.paint.covers import Cover

LEAF, MID, TOP, ROOT = 1, 2, 4, 8  # bits: levels of detail that show a surface
ALL_LEVELS = LEAF | MID | TOP | ROOT
NEAR_LEVELS = LEAF | MID

Colour = tuple[float, float, float]


class Kind(Enum):
    """Building types."""

    GABLE = "gable"
    HIP = "hip"
    L_GABLE = "l_gable"
    ROW = "row"
    FLAT = "flat"
    TOWER = "tower"
    OFFICE = "office"
    HALL = "hall"
    SAWTOOTH = "sawtooth"
    BARN = "barn"
    SHED = "shed"
    CHURCH = "church"
    SILO = "silo"
    TENT = "tent"
    DECK = "deck"
    CONTAINER = "container"


@dataclass(frozen=True)
class Building:
    """A footprint: length along the axis, width across it, metres; `angle` from east, radians.

    base_z: height of the ground floor; foot_z: where walls end below the ground; eaves_m: wall
    height above the floor.
    """

    kind: Kind
    centre: tuple[float, float]
    angle: float
    length: float
    width: float
    eaves_m: float
    base_z: float
    foot_z: float
    seed: int

    def corners(self, margin: float = 0.0) -> Array:
        """Footprint (4, 2) ENU, grown by a margin."""
        return rectangle(self.centre, self.angle, self.length, self.width, margin)


@dataclass(frozen=True)
class Surface:
    """A flat convex polygon (K, 3) ENU, counter-clockwise from outside, and how it is painted.

    right, down: unit vectors of the texture; normal = cross(down, right). extent: width and length
    of the texture in metres from `origin`.
    """

    polygon: Array
    origin: Array
    right: Array
    down: Array
    normal: Array
    extent: tuple[float, float]
    cover: int
    base: Array
    accent: Array
    params: Array
    floor_z: float
    eaves_z: float
    seed: int
    levels: int


def rectangle(
    centre: ArrayLike, angle: float, length: float, width: float, margin: float = 0.0
) -> Array:
    """Corners (4, 2) of a rectangle, counter-clockwise; angle of its length from east (rad);
    metres.
    """
    c, s = np.cos(angle), np.sin(angle)
    a, b = length / 2 + margin, width / 2 + margin
    local = np.array([[-a, -b], [a, -b], [a, b], [-a, b]])
    corners: Array = local @ np.array([[c, s], [-s, c]]) + np.asarray(centre)
    return corners


def _cross(a: Array, b: Array) -> Array:
    """np.cross of two (3,), many times faster."""
    ax, ay, az = a
    bx, by, bz = b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


NO_PARAMS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass
class Shell:
    """Collects the surfaces of one building in its own frame: x along, y across, z up from base.

    Lengths in metres; x, y, z: lowest and highest coordinate; eaves, top: z; pitch: of roofs, rad;
    levels: bits of the levels of detail that show a surface.
    """

    building: Building
    surfaces: list[Surface] = field(default_factory=list)
    base: Colour = (200, 196, 186)
    accent: Colour = (100, 90, 80)
    params: tuple[float, ...] = NO_PARAMS
    roof: Colour = (150, 90, 70)
    roof_cover: Cover = Cover.TILES
    roof_params: tuple[float, ...] = NO_PARAMS

    def add(
        self,
        points: ArrayLike,
        cover: Cover,
        base: Colour,
        accent: Colour = (0, 0, 0),
        params: tuple[float, ...] = NO_PARAMS,
        levels: int = ALL_LEVELS,
        eaves: float | None = None,
    ) -> None:
        """Add a polygon (K, 3) in the building's frame. levels: bits of the levels of detail that
        show it; eaves: z of the eaves, None: the building's.
        """
        b = self.building
        local = np.asarray(points, float)
        c, s = np.cos(b.angle), np.sin(b.angle)
        polygon = np.empty_like(local)
        polygon[:, 0] = b.centre[0] + c * local[:, 0] - s * local[:, 1]
        polygon[:, 1] = b.centre[1] + s * local[:, 0] + c * local[:, 1]
        polygon[:, 2] = b.base_z + local[:, 2]
        normal = _cross(polygon[1] - polygon[0], polygon[2] - polygon[0])
        size = np.sqrt(normal @ normal)
        if size < 1e-6:
            return
        normal /= size
        if abs(normal[2]) > 0.999:
            down = np.array([s, -c, 0.0])
        else:
            down = np.array([0.0, 0.0, -1.0]) + normal[2] * normal
            down /= np.sqrt(down @ down)
        right = _cross(normal, down)
        u, v = polygon @ right, polygon @ down
        anchor = polygon[0]
        origin = anchor + right * (u.min() - u[0]) + down * (v.min() - v[0])
        self.surfaces.append(
            Surface(
                polygon, origin, right, down, normal, (float(np.ptp(u)), float(np.ptp(v))),
                int(cover), np.asarray(base, float), np.asarray(accent, float),
                np.asarray(params, float), b.base_z,
                b.base_z + (b.eaves_m if eaves is None else eaves),
                (b.seed * 131 + len(self.surfaces) * 17) % 1000003, levels,
            )
        )  # fmt: skip

    def wall(self, points: ArrayLike, eaves: float, levels: int = ALL_LEVELS) -> None:
        """Add a facade in the building's style."""
        self.add(points, Cover.FACADE, self.base, self.accent, self.params, levels, eaves)

    def slope(self, points: ArrayLike) -> None:
        """Add a roof surface in the building's style."""
        self.add(points, self.roof_cover, self.roof, self.accent, self.roof_params)

    def walls(self, x: tuple[float, float], y: tuple[float, float], top: float) -> None:
        """Add the four walls of a box, from below the ground to `top`."""
        foot = self.building.foot_z - self.building.base_z
        (x0, x1), (y0, y1) = x, y
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
        for (ax, ay), (bx, by) in pairwise(ring):
            self.wall([(ax, ay, foot), (bx, by, foot), (bx, by, top), (ax, ay, top)], top)

    def box(
        self, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float],
        side: Colour, lid: Colour, levels: int = NEAR_LEVELS,
    ) -> None:  # fmt: skip
        """Add a plain box without a floor: chimneys, vents, lift houses."""
        (x0, x1), (y0, y1), (z0, z1) = x, y, z
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
        for (ax, ay), (bx, by) in pairwise(ring):
            quad = [(ax, ay, z0), (bx, by, z0), (bx, by, z1), (ax, ay, z1)]
            self.add(quad, Cover.PLAIN, side, levels=levels)
        self.add([(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)], Cover.PLAIN, lid,
                 levels=levels)  # fmt: skip

    def gable(
        self, x: tuple[float, float], y: tuple[float, float], eaves: float, pitch: float,
        overhang: float = 0.5, along_x: bool = True,
    ) -> float:  # fmt: skip
        """Add walls with two gables and two slopes; returns the ridge's z."""
        foot = self.building.foot_z - self.building.base_z
        (x0, x1), (y0, y1) = x, y
        if along_x:

            def put(a: float, b: float, z: float) -> tuple[float, float, float]:
                return (a, b, z)

            a0, a1, b0, b1 = x0, x1, y0, y1
        else:  # the same turned by +90 degrees

            def put(a: float, b: float, z: float) -> tuple[float, float, float]:
                return (-b, a, z)

            a0, a1, b0, b1 = y0, y1, -x1, -x0
        mid, rise = (b0 + b1) / 2, (b1 - b0) / 2 * np.tan(pitch)
        ridge, o = eaves + rise, overhang
        low = eaves - o * np.tan(pitch)
        self.wall([put(a0, b0, foot), put(a1, b0, foot), put(a1, b0, eaves), put(a0, b0, eaves)],
                  eaves)  # fmt: skip
        self.wall([put(a1, b1, foot), put(a0, b1, foot), put(a0, b1, eaves), put(a1, b1, eaves)],
                  eaves)  # fmt: skip
        self.wall([put(a1, b0, foot), put(a1, b1, foot), put(a1, b1, eaves), put(a1, mid, ridge),
                   put(a1, b0, eaves)], eaves)  # fmt: skip
        self.wall([put(a0, b1, foot), put(a0, b0, foot), put(a0, b0, eaves), put(a0, mid, ridge),
                   put(a0, b1, eaves)], eaves)  # fmt: skip
        self.slope([put(a0 - o, b0 - o, low), put(a1 + o, b0 - o, low), put(a1 + o, mid, ridge),
                    put(a0 - o, mid, ridge)])  # fmt: skip
        self.slope([put(a1 + o, b1 + o, low), put(a0 - o, b1 + o, low), put(a0 - o, mid, ridge),
                    put(a1 + o, mid, ridge)])  # fmt: skip
        return float(ridge)

    def hip(
        self, x: tuple[float, float], y: tuple[float, float], eaves: float, pitch: float,
        overhang: float = 0.6,
    ) -> float:  # fmt: skip
        """Add four walls under a hipped (or, if square, pyramid) roof; returns the ridge's z."""
        self.walls(x, y, eaves)
        (x0, x1), (y0, y1) = x, y
        o = overhang
        low = eaves - o * np.tan(pitch)
        half = (y1 - y0) / 2 + o
        ridge, mid = low + half * np.tan(pitch), (y0 + y1) / 2
        xa, xb, ya, yb = x0 - o, x1 + o, y0 - o, y1 + o
        ra, rb = min(xa + half, (xa + xb) / 2), max(xb - half, (xa + xb) / 2)
        self.slope([(xa, ya, low), (xb, ya, low), (rb, mid, ridge), (ra, mid, ridge)])
        self.slope([(xb, yb, low), (xa, yb, low), (ra, mid, ridge), (rb, mid, ridge)])
        self.slope([(xb, ya, low), (xb, yb, low), (rb, mid, ridge)])
        self.slope([(xa, yb, low), (xa, ya, low), (ra, mid, ridge)])
        return float(ridge)

    def flat(
        self, x: tuple[float, float], y: tuple[float, float], top: float, parapet: float = 0.7
    ) -> None:
        """Add walls with a parapet around a flat roof."""
        self.walls(x, y, top + parapet)
        (x0, x1), (y0, y1) = x, y
        self.slope([(x0, y0, top), (x1, y0, top), (x1, y1, top), (x0, y1, top)])
        if parapet <= 0:
            return
        w, z = 0.35, top + parapet
        rim = (196.0, 194.0, 188.0)
        outer = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        inner = [(x0 + w, y0 + w), (x1 - w, y0 + w), (x1 - w, y1 - w), (x0 + w, y1 - w)]
        for k in range(4):
            m = (k + 1) % 4
            self.add([(*outer[k], z), (*outer[m], z), (*inner[m], z), (*inner[k], z)],
                     Cover.PLAIN, rim, levels=NEAR_LEVELS)  # fmt: skip
            self.add([(*inner[m], top), (*inner[k], top), (*inner[k], z), (*inner[m], z)],
                     Cover.PLAIN, self.base, levels=LEAF)  # fmt: skip
