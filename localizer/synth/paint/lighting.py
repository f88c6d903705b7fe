"""Shadows and sky light from a digital surface model of everything that stands in the world."""

# ruff: noqa: PLR1730 (kernels pass arrays)
from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.config import VisitLook
from localizer.synth.paint.covers import WindowLight

DSM_GSD_M = 0.5
SHADOW_REACH_M = 90.0


@njit(cache=True, nogil=True, fastmath=True)
def raise_surface(dsm, triangles, west, north, gsd):  # type: ignore[no-untyped-def]
    """Raise dsm (H, W) float32 to the height of triangles (T, 3, 3) ENU seen from above."""
    rows, columns = dsm.shape
    for k in range(triangles.shape[0]):
        ax = (triangles[k, 0, 0] - west) / gsd - 0.5
        ay = (north - triangles[k, 0, 1]) / gsd - 0.5
        bx = (triangles[k, 1, 0] - west) / gsd - 0.5
        by = (north - triangles[k, 1, 1]) / gsd - 0.5
        cx = (triangles[k, 2, 0] - west) / gsd - 0.5
        cy = (north - triangles[k, 2, 1]) / gsd - 0.5
        az, bz, cz = triangles[k, 0, 2], triangles[k, 1, 2], triangles[k, 2, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-6:
            continue
        left = max(int(np.ceil(min(ax, bx, cx))), 0)
        right = min(int(np.floor(max(ax, bx, cx))), columns - 1)
        top = max(int(np.ceil(min(ay, by, cy))), 0)
        bottom = min(int(np.floor(max(ay, by, cy))), rows - 1)
        for i in range(top, bottom + 1):
            for j in range(left, right + 1):
                u = ((bx - j) * (cy - i) - (by - i) * (cx - j)) / area
                v = ((cx - j) * (ay - i) - (cy - i) * (ax - j)) / area
                if u >= 0 and v >= 0 and u + v <= 1:
                    z = u * az + v * bz + (1 - u - v) * cz
                    if z > dsm[i, j]:
                        dsm[i, j] = z


_CELL = 16  # pixels; a ray leaps over cells that cannot reach it


def _reachable(dsm: NDArray[np.float32]) -> NDArray[np.float32]:
    """Highest surface (h, w) within a cell of _CELL pixels and its eight neighbours."""
    rows, columns = (-(-n // _CELL) for n in dsm.shape)
    padded = np.full((rows * _CELL, columns * _CELL), dsm.min(), np.float32)
    padded[: dsm.shape[0], : dsm.shape[1]] = dsm
    cells = padded.reshape(rows, _CELL, columns, _CELL).max(axis=(1, 3))
    return np.asarray(cv2.dilate(cells, np.ones((3, 3), np.uint8)), np.float32)


@njit(cache=True, nogil=True, fastmath=True)
def _shadow_ceiling(  # type: ignore[no-untyped-def]
    dsm, reachable, top, left, step_u, step_v, drop, steps, out
):
    """Write to out[i, j] the height below which it is in shadow: max over t of dsm(p + t sun) - t
    tan.
    """
    rows, columns = dsm.shape
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            best = -1e9
            u, v = float(left + j), float(top + i)
            k = 2
            while k < steps:
                a, b = u + k * step_u, v + k * step_v
                if a < 0 or b < 0 or a >= columns - 1 or b >= rows - 1:
                    break
                ia, ib = int(a), int(b)
                if (k - 2) % _CELL == 0 and reachable[ib // _CELL, ia // _CELL] - k * drop <= best:
                    k += _CELL
                    continue
                fa, fb = a - ia, b - ib
                z = (dsm[ib, ia] * (1 - fa) + dsm[ib, ia + 1] * fa) * (1 - fb)
                z += (dsm[ib + 1, ia] * (1 - fa) + dsm[ib + 1, ia + 1] * fa) * fb
                best = max(best, z - k * drop)
                k += 1
            out[i, j] = best


def make_light(
    dsm: NDArray[np.float32],
    ground: NDArray[np.float32],
    dsm_west: float,
    dsm_north: float,
    window: tuple[int, int, int, int],
    look: VisitLook,
) -> WindowLight:
    """Light of a window (top, left, height, width; pixels of the surface model).

    dsm, ground: (H, W) heights with and without what stands on the ground; their top-left corner is
    (dsm_west, dsm_north).
    """
    top, left, height, width = window
    # Everything that can throw a shadow into the window.
    reach = int(SHADOW_REACH_M / DSM_GSD_M) + 2
    row, column = max(0, top - reach), max(0, left - reach)
    crop = np.s_[row : top + height + reach, column : left + width + reach]
    near, above = np.ascontiguousarray(dsm[crop]), dsm[crop] - ground[crop]
    view = np.s_[top - row : top - row + height, left - column : left - column + width]
    sun: Array = look.sun_direction
    level = float(np.hypot(sun[0], sun[1]))
    ceiling = np.empty((height, width), np.float32)
    _shadow_ceiling(
        near, _reachable(near), top - row, left - column, sun[0] / level, -sun[1] / level,
        DSM_GSD_M * sun[2] / level, reach, ceiling,
    )  # fmt: skip
    closed = np.zeros((height, width), np.float32)
    # Neighbours that rise over a point hide sky: near ones more sharply than far ones.
    for sigma_m, weight in ((1.0, 0.05), (3.5, 0.045), (9.0, 0.03)):
        closed += weight * cv2.GaussianBlur(above, (0, 0), sigma_m / DSM_GSD_M)[view]
    ambient = (1.0 / (1.0 + closed * 1.6)).astype(np.float32)
    return WindowLight(
        ceiling=ceiling,
        ambient=ambient,
        west=dsm_west + left * DSM_GSD_M,
        north=dsm_north - top * DSM_GSD_M,
        gsd_m=DSM_GSD_M,
        sun=sun.astype(np.float32),
        sun_rgb=np.array(look.sun_rgb, np.float32),
        sky_rgb=np.array(look.sky_rgb, np.float32) * 1.15,
        season=np.array([look.dryness, look.crop, look.leaf], np.float32),
    )
