"""The street net: a warped lattice, thinned to main roads, side streets and country lanes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from localizer.geometry.pose import Array
from localizer.synth.config import WorldConfig
from localizer.synth.paint.ground_plan import GroundPlan, Material
from localizer.synth.plan.terrain import Terrain

MAIN_WIDTH_M, SIDE_WIDTH_M, LANE_WIDTH_M = 9.0, 6.0, 3.6
LAYER_PAVEMENT, LAYER_KERB, LAYER_ROAD, LAYER_MARK = 50, 51, 52, 53
_SUB = 8  # points per lattice edge
_STOP_M = 9.0  # markings end this far before a junction


@dataclass(frozen=True)
class Street:
    """One lattice edge. points: (N, 2) ENU from node `a` to `b`; rank 0 main, 1 side, 2 lane."""

    points: Array
    a: int
    b: int
    rank: int

    @property
    def width_m(self) -> float:
        """Width of the carriageway in metres."""
        return (MAIN_WIDTH_M, SIDE_WIDTH_M, LANE_WIDTH_M)[self.rank]

    @property
    def pavement_m(self) -> float:
        """Width of the pavement on each side in metres."""
        return (2.6, 1.7, 0.0)[self.rank]

    @property
    def reach_m(self) -> float:
        """Half the width of the whole street: where plots begin."""
        return self.width_m / 2 + self.pavement_m


@dataclass(frozen=True)
class Lattice:
    """Nodes (I, J, 2) of the warped lattice; cell (i, j) lies between nodes i..i+1, j..j+1."""

    u: Array
    v: Array
    angle: float
    waves: Array  # (K, 5): wave vector x, y, phase, amplitude x, y

    def warp(self, uv: Array) -> Array:
        """Convert lattice coordinates (..., 2) to ENU metres (..., 2)."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        xy = uv @ np.array([[c, s], [-s, c]])
        phase = xy @ self.waves[:, :2].T + self.waves[:, 2]
        return np.asarray(xy + np.sin(phase) @ self.waves[:, 3:])

    def line(self, a: tuple[int, int], b: tuple[int, int]) -> Array:
        """The curved edge between two lattice nodes (column, row): (N, 2), ENU metres."""
        p = np.array([self.u[a[0]], self.v[a[1]]])
        q = np.array([self.u[b[0]], self.v[b[1]]])
        t = np.linspace(0, 1, _SUB + 1)[:, None]
        return self.warp(p + t * (q - p))

    def cell(self, i: int, j: int) -> Array:
        """Outline (N, 2) of a cell, ENU m, counter-clockwise; equally many points on each side."""
        corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1), (i, j)]
        parts = [self.line(p, q)[:-1] for p, q in pairwise(corners)]
        return np.concatenate(parts)

    def centre(self, i: int, j: int) -> Array:
        """Middle (2,) of a cell."""
        uv = np.array([self.u[i] + self.u[i + 1], self.v[j] + self.v[j + 1]]) / 2
        return self.warp(uv)


@dataclass(frozen=True)
class StreetNet:
    """The lattice, the streets that exist, and for every cell its four sides' streets."""

    lattice: Lattice
    streets: list[Street]
    nodes: Array  # (n, 2) ENU
    main_lines: list[Array]
    edge_street: dict[tuple[tuple[int, int], tuple[int, int]], Street]

    def side(self, a: tuple[int, int], b: tuple[int, int]) -> Street | None:
        """The street between two neighbouring lattice nodes; None without one."""
        return self.edge_street.get((min(a, b), max(a, b)))


def make_lattice(config: WorldConfig) -> Lattice:
    """Irregular lines 68 to 118 m apart, turned and bent; they reach beyond the world's edge."""
    rng = config.rng(10)
    reach = 0.78 * config.size_m + 60.0

    def lines() -> Array:
        steps = rng.uniform(68, 118, int(2 * reach / 68) + 2)
        at = np.cumsum(steps) - reach - rng.uniform(0, 60)
        return np.asarray(at[at < reach + 60.0])

    waves = []
    for wavelength, amplitude in ((900.0, 26.0), (640.0, 17.0), (430.0, 9.0)):
        for _ in range(2):
            heading, phase = rng.uniform(0, 2 * np.pi, 2)
            k = 2 * np.pi / (wavelength * rng.uniform(0.85, 1.15))
            push = rng.normal(0, amplitude, 2)
            waves.append((k * np.cos(heading), k * np.sin(heading), phase, *push))
    return Lattice(lines(), lines(), float(rng.uniform(0, np.pi / 2)), np.array(waves))


def _main_indices(rng: np.random.Generator, lines: Array, dry: list[bool]) -> set[int]:
    """The line nearest the middle and about every fifth on both sides, none along the river."""
    order = np.argsort(np.abs(lines - rng.uniform(-40, 40)))
    first = next((int(k) for k in order if dry[k]), int(order[0]))
    chosen = {first}
    for direction in (-1, 1):
        i = first + direction * int(rng.integers(4, 7))
        while 0 <= i < len(lines):
            if dry[i]:
                chosen.add(i)
                i += direction * int(rng.integers(4, 7))
            else:
                i += direction
    return chosen


def make_streets(config: WorldConfig, terrain: Terrain, urban: dict[tuple[int, int], bool],
                 lattice: Lattice) -> StreetNet:  # fmt: skip
    """Choose which lattice edges become streets, so that all streets form one connected net. urban:
    for each cell (column, row), whether it is built up.
    """
    rng = config.rng(11)
    nu, nv = len(lattice.u), len(lattice.v)
    limit = config.half_m + 60.0

    def is_dry(line: Array) -> bool:
        inside = line[np.abs(line).max(1) < limit]
        if len(inside) == 0:
            return True
        distance, nearest = terrain.river.distance(inside)
        return bool((distance < terrain.river.width[nearest] / 2 + 20).mean() < 0.14)

    main_u = _main_indices(
        rng, lattice.u, [is_dry(_long_line(lattice, i, None)) for i in range(nu)]
    )
    main_v = _main_indices(
        rng, lattice.v, [is_dry(_long_line(lattice, None, j)) for j in range(nv)]
    )

    def node(i: int, j: int) -> int:
        return i * nv + j

    found: list[tuple[tuple[int, int], tuple[int, int], Street]] = []
    for i in range(nu):
        for j in range(nv):
            for di, dj in ((1, 0), (0, 1)):
                a, b = (i, j), (i + di, j + dj)
                if b[0] >= nu or b[1] >= nv:
                    continue
                points = lattice.line(a, b)
                if np.abs(points).max(1).min() > limit:
                    continue
                main = (j in main_v) if di else (i in main_u)
                if di:
                    sides = [urban.get((i, j), False), urban.get((i, j - 1), False)]
                else:
                    sides = [urban.get((i, j), False), urban.get((i - 1, j), False)]
                distance, nearest = terrain.river.distance(points)
                wet = bool((distance < terrain.river.width[nearest] / 2 + 8).any())
                rank = _rank(main, wet, sum(sides), rng.random())
                if rank is not None:
                    found.append((a, b, Street(points, node(*a), node(*b), rank)))

    found = _largest_component(found, nu * nv)
    uv = np.stack(np.meshgrid(lattice.u, lattice.v, indexing="ij"), -1)
    nodes = lattice.warp(uv).reshape(-1, 2)
    lines = [_long_line(lattice, i, None) for i in sorted(main_u)]
    lines += [_long_line(lattice, None, j) for j in sorted(main_v)]
    return StreetNet(
        lattice, [s for *_, s in found], nodes, lines, {(a, b): s for a, b, s in found}
    )


def _rank(main: bool, wet: bool, urban_sides: int, draw: float) -> int | None:
    """Rank of a lattice edge, None for no street; only main roads cross the river."""
    if main:
        return 0
    if wet or draw > (0.22, 0.75, 0.90)[urban_sides]:
        return None
    return 1 if urban_sides else 2


def _largest_component(
    edges: list[tuple[tuple[int, int], tuple[int, int], Street]], n: int
) -> list[tuple[tuple[int, int], tuple[int, int], Street]]:
    rows, columns = [s.a for *_, s in edges], [s.b for *_, s in edges]
    ends = (np.array(rows), np.array(columns))
    graph = coo_matrix((np.ones(len(edges)), ends), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    best = np.bincount(label[rows]).argmax()
    return [e for e in edges if label[e[2].a] == best]


def _long_line(lattice: Lattice, i: int | None, j: int | None) -> Array:
    if i is not None:
        v = np.arange(lattice.v[0], lattice.v[-1], 4.0)
        uv = np.stack([np.full_like(v, lattice.u[i]), v], -1)
    else:
        u = np.arange(lattice.u[0], lattice.u[-1], 4.0)
        uv = np.stack([u, np.full_like(u, lattice.v[j if j is not None else 0])], -1)
    return lattice.warp(uv)


def offset_line(points: Array, offset_m: float) -> Array:
    """A line (N, 2), metres, moved sideways by offset_m, positive to the left of its direction."""
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    return points + offset_m * normal


def resample(points: Array, step_m: float) -> Array:
    """Points (N, 2) or (N, 3) at equal steps along a line, metres. Both ends are included, so steps
    are at most step_m.
    """
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    n = max(2, int(np.ceil(s[-1] / step_m)) + 1)
    at = np.linspace(0, s[-1], n)
    return np.stack([np.interp(at, s, points[:, k]) for k in range(points.shape[1])], -1)


def cut_ends(points: Array, start_m: float, end_m: float) -> Array | None:
    """The line (N, 2) without its first and last metres, at 1 m steps; None if nothing is left."""
    fine = resample(points, 1.0)
    kept = fine[round(start_m) : len(fine) - round(end_m)]
    return kept if len(kept) >= 3 else None


def paint_streets(net: StreetNet, plan: GroundPlan) -> None:
    """Add pavements, kerbs, carriageways, markings, stop lines and zebra crossings to the plan."""
    degree = np.bincount([n for s in net.streets for n in (s.a, s.b)], minlength=len(net.nodes))
    rank_at = np.full(len(net.nodes), 9)
    for street in net.streets:
        for n in (street.a, street.b):
            rank_at[n] = min(rank_at[n], street.rank)
    mark = plan.region(Material.MARKING, vary=0.02)
    kerb = plan.region(Material.KERB, vary=0.02)
    asphalt = {
        rank: [plan.region(Material.ASPHALT, vary=0.07) for _ in range(6)] for rank in (0, 1)
    }
    slabs = [plan.region(Material.PAVEMENT, vary=0.05) for _ in range(8)]
    for k, street in enumerate(net.streets):
        points, width = street.points, street.width_m
        heading = points[-1] - points[0]
        angle = float(np.arctan2(heading[1], heading[0]))
        if street.rank == 2:
            region = plan.region(
                Material.GRAVEL if k % 3 else Material.ASPHALT, angle=angle, vary=0.08
            )
            plan.stroke(LAYER_KERB - 2, points, width, region)
            continue
        plan.stroke(LAYER_PAVEMENT, points, width + 2 * street.pavement_m, slabs[k % 8])
        plan.stroke(LAYER_KERB, points, width + 0.5, kerb)
        plan.stroke(LAYER_ROAD, points, width, asphalt[street.rank][k % 6])
        _paint_marks(street, plan, mark, degree, rank_at)


def _paint_marks(
    street: Street,
    plan: GroundPlan,
    mark: int,
    degree: NDArray[np.int64],
    rank_at: NDArray[np.int64],
) -> None:
    width = street.width_m
    junction = [degree[n] >= 3 for n in (street.a, street.b)]
    gaps = [_STOP_M if j else 0.0 for j in junction]
    line = cut_ends(street.points, *gaps)
    if line is None:
        return
    if street.rank == 0:
        for side in (-1, 1):
            plan.stroke(LAYER_MARK, offset_line(line, side * (width / 2 - 0.45)), 0.15, mark)
    dash, period = (3, 9) if street.rank == 0 else (2, 8)
    for k in range(0, len(line) - dash, period):
        plan.stroke(LAYER_MARK, line[k : k + dash + 1], 0.15, mark)
    for end, at_junction in enumerate(junction):
        if not at_junction:
            continue
        ordered = line if end == 0 else line[::-1]
        inward = ordered[1] - ordered[0]
        inward /= np.linalg.norm(inward)
        left = np.array([-inward[1], inward[0]])
        node = street.a if end == 0 else street.b
        if street.rank == 0 or rank_at[node] == 0:
            for across in np.arange(-width / 2 + 0.6, width / 2 - 0.3, 1.0):
                corner = ordered[0] + left * across - inward * 2.2
                quad = [corner, corner + left * 0.5]
                quad += [quad[1] + inward * 2.8, corner + inward * 2.8]
                plan.polygon(LAYER_MARK, quad, mark)
        if street.rank == 1 or degree[node] >= 4:
            start = ordered[0] + inward * 1.6
            # Traffic keeps right: who drives towards the junction is on the left of `inward`.
            plan.stroke(LAYER_MARK, [start + left * 0.2, start + left * (width / 2 - 0.5)], 0.4,
                        mark)  # fmt: skip
