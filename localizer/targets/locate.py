"""Locates pixels: rays from the estimated pose, with covariance and all possible surfaces.

Paper, Sec. 3.3.2 (end): a pixel is located by a ray from the estimated pose. At a roof's edge the
errors of pose and pixel decide which surface the ray hits. So a bundle of rays samples these
errors, and every surface hit is returned with its probability.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from localizer.geometry.pose import Array, hat
from localizer.map.cache.pick import BundleHits
from localizer.types import PoseEstimate, TargetSurface

RayCaster = Callable[[Array, Array], BundleHits]
"""Origin (3,) and unit directions (N, 3), close about one, in the map frame, to what they meet."""

_ORDER = 5  # Gauss-Hermite nodes per axis of the bundle: out to 2.86 sigma
_STEP_SIGMA = 1.5  # the widest gap between neighbouring nodes
# Neighbouring rays of one surface differ in distance by their spacing times the tangent of the
# incidence: 4 stands for 76 degrees.
_STEEPNESS = 4.0
# Most outlines lie within the map's error, but a crown that has grown and an extension that was
# built lie metres beside theirs: so many sigmas, in one case of ten.
_GROWN_SIGMAS, _GROWN_SHARE, _GROWN_RAYS = 4.0, 0.1, 8
_SMALLEST_STEP_M = 1.0
# At grazing incidence the plane model explodes: 3 degrees is where we stop believing it.
_MIN_COSINE = 0.05

# The middle of what is rough, as a crown, is off by twice what its hits deviate: a variance.
_ROUGH = 4.0
_AIM = 0.2  # of a pixel's variance: a detector's aim is off alike in all frames of one view


@dataclass(frozen=True)
class RaySpread:
    """Uncertainty of a ray's direction. sideways: (2, 3) unit vectors across the ray; pose, pixel:
    (2, 2) rad² along them, from the errors of pose and pixel.
    """

    sideways: Array
    pose: Array
    pixel: Array

    @property
    def covariance(self) -> Array:
        """Sum of both, (2, 2) rad²."""
        total: Array = self.pose + self.pixel
        return total


def ray_in_world(estimate: PoseEstimate, pixel: tuple[float, float]) -> tuple[Array, Array]:
    """Origin (3,) and unit direction (3,) in world axes of a pixel of the (distorted) frame."""
    direction = estimate.world_from_camera.rotation @ estimate.camera.rays(np.asarray(pixel))
    return estimate.world_from_camera.translation, direction / np.linalg.norm(direction)


def ray_spread(
    estimate: PoseEstimate,
    pixel: tuple[float, float],
    pixel_sigma: float,
    distance: float,
    drift: tuple[float, float] = (0.0, 0.0),
) -> RaySpread:
    """Uncertainty of a pixel's ray, first order.

    A point at ``s d`` from the camera moves across the ray by ``dC + s [phi]x d``; a pixel error
    rotates the ray by the derivative of the camera model. drift: one sigma of an error (pixels)
    along a line, for example of a click whose frame is uncertain. pixel_sigma: of the pixel, px,
    per axis. distance: along the ray, m.
    """
    _, d = ray_in_world(estimate, pixel)
    sideways = np.linalg.svd(d[None, :])[2][1:]
    from_pose = np.hstack([sideways / distance, -sideways @ hat(d)])
    moved = [ray_in_world(estimate, (pixel[0] + du, pixel[1] + 1 - du))[1] for du in (1, 0)]
    turn = sideways @ (np.array(moved) - d).T
    pixels = pixel_sigma**2 * np.eye(2) + np.outer(drift, drift)
    return RaySpread(
        sideways, from_pose @ estimate.covariance @ from_pose.T, turn @ pixels @ turn.T
    )


def surface_covariance(
    offset: Array, normal: Array, spread: RaySpread, map_sigma_m: float
) -> Array:
    """Covariance (3, 3) in m², world axes, of a ray's hit on a surface.

    offset: (3,) from the camera to the hit; normal: (3,) of the surface; spread: of the ray. First
    order about the tangent plane: a displacement e across the ray moves the hit by ``M e``, ``M = I
    - d n' / (n' d)``. map_sigma_m is added along the ray.
    """
    distance = float(np.linalg.norm(offset))
    d = offset / distance
    cosine = float(normal @ d)
    cosine = np.copysign(max(abs(cosine), _MIN_COSINE), cosine or -1.0)
    M = (np.eye(3) - np.outer(d, normal) / cosine) @ spread.sideways.T * distance
    P = M @ spread.covariance @ M.T + np.outer(d, d) * (map_sigma_m / cosine) ** 2
    return np.asarray(0.5 * (P + P.T))


def locate(
    estimate: PoseEstimate,
    pixel: tuple[float, float],
    cast: RayCaster,
    pixel_sigma: float,
    map_sigma_m: float,
    drift: tuple[float, float] = (0.0, 0.0),
    outline_sigma_m: float = 0.0,
) -> tuple[TargetSurface, ...]:
    """The surfaces that a pixel may show, most probable first; empty if it shows no map.

    If the whole ray bundle hits one surface, its position is the exact hit of the pixel's ray.
    Otherwise a surface's position is the mean of its own hits. drift: as of `ray_spread`.
    outline_sigma_m: error of the map's outlines (roofs, crowns) against today's; it decides which
    surfaces are hit, and is no error of a position on a surface. pixel_sigma: of the pixel, px, per
    axis. map_sigma_m: of the map's surface.
    """
    eye, d = ray_in_world(estimate, pixel)
    distance = float(cast(eye, d[None, :]).distances[0])
    if not np.isfinite(distance):
        return ()
    spread = ray_spread(estimate, pixel, pixel_sigma, distance, drift)
    directions, weights = _bundle(d, spread, outline_sigma_m / distance)
    hits = cast(eye, directions)
    centre = int(np.argmax(weights))
    gap = _STEP_SIGMA * distance * float(np.sqrt(spread.covariance.trace())) + outline_sigma_m
    groups = _surfaces(hits, directions, gap)
    surfaces = []
    for group in groups:
        share = weights[group] / weights[group].sum()
        points = directions[group] * hits.distances[group, None]
        offset = points[group == centre][0] if centre in group else share @ points
        normal = share @ hits.normals[group]
        normal = normal / max(float(np.linalg.norm(normal)), 1e-9)
        own = ray_spread(estimate, pixel, pixel_sigma, float(np.linalg.norm(offset)), drift)
        covariance = surface_covariance(offset, normal, own, map_sigma_m)
        rough = _ROUGH * float(share @ ((points - offset) @ normal) ** 2)
        cosine = max(abs(float(normal @ d)), _MIN_COSINE)
        covariance += np.outer(d, d) * rough / cosine**2
        view = replace(own, pixel=_AIM * own.pixel)
        repeats = surface_covariance(offset, normal, view, 0.0)
        probability = float(weights[group].sum())
        surfaces.append(TargetSurface(probability, eye + offset, covariance, normal, repeats))
    total = sum(s.probability for s in surfaces)
    found = (replace(s, probability=s.probability / total) for s in surfaces)
    return tuple(sorted(found, key=lambda s: -s.probability))


@cache
def _nodes() -> tuple[Array, Array]:
    """Gauss-Hermite quadrature of the plane's standard normal: nodes (N, 2), weights (N,)."""
    x, w = np.polynomial.hermite_e.hermegauss(_ORDER)
    grid = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    return grid, np.outer(w, w).ravel() / w.sum() ** 2


def _bundle(d: Array, spread: RaySpread, outline_rad: float) -> tuple[Array, Array]:
    """Directions (N, 3) about d (3,) that sample the errors of a pixel's ray, and weights (N,)."""
    nodes, weights = _nodes()
    met = spread.covariance + outline_rad**2 * np.eye(2)
    offsets = nodes @ np.linalg.cholesky(met).T @ spread.sideways
    if outline_rad > 0.0:
        turns = np.arange(_GROWN_RAYS) * 2 * np.pi / _GROWN_RAYS
        ring = np.column_stack([np.cos(turns), np.sin(turns)]) @ spread.sideways
        offsets = np.vstack([offsets, _GROWN_SIGMAS * outline_rad * ring])
        of_ring = np.full(_GROWN_RAYS, _GROWN_SHARE / _GROWN_RAYS)
        weights = np.concatenate([(1 - _GROWN_SHARE) * weights, of_ring])
    directions = d + offsets
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return directions, weights


def _surfaces(hits: BundleHits, directions: Array, gap: float) -> list[np.ndarray]:
    """Indices of the hits by surface: sorted distances are split where they differ by more than the
    slopes explain. gap: metres between neighbouring rays.
    """
    order = np.argsort(hits.distances)
    order = order[np.isfinite(hits.distances[order])]
    cosines = np.abs(np.einsum("ni,ni->n", hits.normals, directions))[order]
    slopes = np.minimum(np.sqrt(1.0 / np.maximum(cosines, 1e-3) ** 2 - 1.0), _STEEPNESS)
    steps = np.maximum(gap * np.maximum(slopes[1:], slopes[:-1]), _SMALLEST_STEP_M)
    return np.split(order, np.flatnonzero(np.diff(hits.distances[order]) > steps) + 1)
