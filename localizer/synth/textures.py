"""Texture synthesis: numba kernels that paint ground, roofs, facades and tree crowns, lit.

Every texel knows its place in the world, and noise is a hash of that place, so textures do not
repeat, tiles join without seams, and two visits differ only in what the `Look` says. Colours are
sRGB values used as albedo; light is ``sky * ambient_occlusion + sun * cos(angle) * lit``.
"""

# ruff: noqa: PLR0912, PLR0915, PLR0911, PLW3301, PLR1714, SIM102 (kernels pass arrays and
# branch over materials)
from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.types import Image


class Cover(IntEnum):
    """What a building surface is made of; the kernel knows each by this number."""

    PLAIN = 0
    FACADE = 1
    TILES = 2
    GRAVEL = 3
    BITUMEN = 4
    METAL = 5
    GREEN = 6
    GLASS = 7
    DECK = 8  # car-park deck with bays
    SLATE = 9
    HEDGE = 10


class FacadeStyle(IntEnum):
    """Window layout and wall structure of a facade."""

    HOUSE = 0
    APARTMENT = 1
    HALL = 2
    CHURCH = 3
    OFFICE = 4
    BARN = 5
    BLANK = 6
    BRICK = 7


@dataclass(frozen=True)
class Light:
    """Light of one window of the world. ceiling: (h, w) float32 height below which a point is in
    shadow; ambient: (h, w) float32 visible share of the sky at the ground; top-left corner (west,
    north), `gsd_m` per pixel; sun: unit vector (3,); season: dryness, crop, leaf.
    """

    ceiling: NDArray[np.float32]
    ambient: NDArray[np.float32]
    west: float
    north: float
    gsd_m: float
    sun: NDArray[np.float32]
    sun_rgb: NDArray[np.float32]
    sky_rgb: NDArray[np.float32]
    season: NDArray[np.float32]


@njit(cache=True, nogil=True, inline="always")
def _hash(ix, iy, seed):  # type: ignore[no-untyped-def]
    h = (ix * 374761393 + iy * 668265263 + seed * 974634421) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFF) * (1.0 / 16777216.0)


@njit(cache=True, nogil=True, inline="always")
def _noise(x, y, seed):  # type: ignore[no-untyped-def]
    """Value noise in [-0.5, 0.5], one lattice cell per unit."""
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = int(fx), int(fy)
    tx, ty = x - fx, y - fy
    tx, ty = tx * tx * (3 - 2 * tx), ty * ty * (3 - 2 * ty)
    a, b = _hash(ix, iy, seed), _hash(ix + 1, iy, seed)
    c, d = _hash(ix, iy + 1, seed), _hash(ix + 1, iy + 1, seed)
    return (a + tx * (b - a)) * (1 - ty) + (c + tx * (d - c)) * ty - 0.5


@njit(cache=True, nogil=True, inline="always")
def _step(x, low, high):  # type: ignore[no-untyped-def]
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3 - 2 * t)


@njit(cache=True, nogil=True, inline="always")
def _bilinear(grid, u, v):  # type: ignore[no-untyped-def]
    """Sample at column u, row v (sample centres at integers), clamped."""
    h, w = grid.shape
    u = min(max(u, 0.0), w - 1.001)
    v = min(max(v, 0.0), h - 1.001)
    i, j = int(v), int(u)
    fu, fv = u - j, v - i
    top = grid[i, j] + fu * (grid[i, j + 1] - grid[i, j])
    low = grid[i + 1, j] + fu * (grid[i + 1, j + 1] - grid[i + 1, j])
    return top + fv * (low - top)


@njit(cache=True, nogil=True, inline="always")
def _byte(x):  # type: ignore[no-untyped-def]
    return np.uint8(min(max(x, 0.0), 255.0))


@njit(cache=True, nogil=True, fastmath=True)
def _ground_albedo(material, x, y, angle, spacing, seed, dryness, crop, leaf, rgb):  # type: ignore[no-untyped-def]
    """Colour of one ground texel at ENU (x, y) into rgb (3,)."""
    n1 = _noise(x * 3.1, y * 3.1, 11)
    n2 = _noise(x * 0.83, y * 0.83, 12)
    n3 = _noise(x * 0.19, y * 0.19, 13)
    n4 = _noise(x * 0.037, y * 0.037, 14)
    grain = _hash(int(np.floor(x * 8)), int(np.floor(y * 8)), 15) - 0.5
    ca, sa = np.cos(angle), np.sin(angle)
    along, across = ca * x + sa * y, ca * y - sa * x
    r = g = b = 128.0
    if material == 0 or material == 1 or material == 11:  # meadow, lawn, sports turf
        if material == 0:
            r, g, b = 104.0, 112.0, 68.0
            rough = 1.0
        elif material == 1:
            r, g, b = 96.0, 112.0, 68.0
            rough = 0.75
        else:
            r, g, b = 86.0, 114.0, 66.0
            rough = 0.45
        tuft = _noise(x * 0.42 + 3 * n3, y * 0.42, 16)
        dry = min(max(dryness + 1.1 * n4 + 0.9 * n3 * rough + 0.5 * tuft - 0.1, 0.0), 1.0)
        if material == 11:
            dry *= 0.35
        r += dry * (172.0 - r)
        g += dry * (156.0 - g)
        b += dry * (104.0 - b)
        value = 1 + rough * (0.34 * n1 + 0.30 * n2 + 0.22 * tuft + 0.28 * grain) + 0.15 * n4
        if material == 1:
            value *= 1 + 0.05 * np.sign(np.sin(across * 2 * np.pi / 1.9 + seed))
        if material == 11:
            value *= 1 + 0.09 * np.sign(np.sin(along * np.pi / 5.0 + seed))
        # Bare patches and molehills.
        if material == 0 and n2 + tuft > 0.62:
            r, g, b = 128.0, 106.0, 78.0
    elif material == 2:  # asphalt: patches, seams, cracks, tyre lanes
        r, g, b = 108.0, 107.0, 108.0
        patch = _hash(int(np.floor(along / 7.3 + n3)), int(np.floor(across / 3.1)), int(seed))
        value = 1 + 0.22 * n1 + 0.18 * n2 + 0.24 * n3 + 0.16 * n4 + 0.30 * grain
        if patch > 0.92:
            value *= 0.86
        elif patch < 0.05:
            value *= 1.10
        crack = abs(_noise(x * 0.35 + 0.6 * n2, y * 0.35 + 0.5 * n1, 17))
        if crack < 0.012:
            value *= 0.68
        stain = _noise(x * 0.55, y * 0.55, 18)
        if stain > 0.33:
            value *= 0.80
    elif material == 3:  # slabs
        r, g, b = 164.0, 160.0, 152.0
        i, j = np.floor(x / 1.2), np.floor(y / 1.2)
        value = 1 + 0.16 * (_hash(int(i), int(j), 21) - 0.5) + 0.12 * n1 + 0.2 * n3 + 0.14 * grain
        if x / 1.2 - i < 0.09 or y / 1.2 - j < 0.09:
            value *= 0.80
    elif material == 4:  # worn paint
        r, g, b = 226.0, 226.0, 220.0
        value = 1 + 0.25 * n1 + 0.15 * n3
        if n1 + 0.8 * n2 > 0.42:
            r, g, b = 120.0, 118.0, 116.0
    elif material == 5:
        r, g, b = 172.0, 160.0, 138.0
        value = 1 + 0.30 * n1 + 0.16 * n2 + 0.22 * n3 + 0.34 * grain
        if n2 + n3 > 0.52:
            r, g, b = 104.0, 112.0, 66.0
    elif material == 6 or material == 7 or material == 8:
        wobble = 0.25 * n3 + 0.1 * n2
        phase = across / spacing + wobble / spacing
        row = 0.5 + 0.5 * np.cos(2 * np.pi * phase)
        # The same field ripens from soil over green to grain; each a little earlier or later.
        stage = crop + (0.45 if material == 8 else (-0.5 if material == 7 else 0.0))
        stage += 0.24 * (_hash(int(seed), 3, 7) - 0.5) + 0.12 * n4
        soil_v = 1 + 0.22 * n1 + 0.24 * n2 + 0.2 * n3 + 0.25 * grain
        sr, sg, sb = 136.0 * soil_v, 112.0 * soil_v, 86.0 * soil_v
        green = _step(stage, 0.12, 0.42)
        ripe = _step(stage, 0.72, 0.98)
        pr, pg, pb = 94.0, 114.0, 62.0
        hue = _hash(int(seed), 5, 9)
        pr, pg = pr + 24 * hue, pg + 12 * hue
        pr, pg, pb = pr + ripe * (194 - pr), pg + ripe * (168 - pg), pb + ripe * (104 - pb)
        plant_v = 1 + 0.30 * n1 + 0.26 * n2 + 0.26 * n3 + 0.18 * n4 + 0.25 * grain
        keep = green * min(1.0, 0.35 + 0.65 * row + 0.5 * green + 0.7 * n3)
        if green < 0.5:
            sr, sg, sb = sr * (0.86 + 0.2 * row), sg * (0.86 + 0.2 * row), sb * (0.86 + 0.2 * row)
        r = sr + keep * (pr * plant_v - sr)
        g = sg + keep * (pg * plant_v - sg)
        b = sb + keep * (pb * plant_v - sb)
        tram = across / 15.0 + _hash(int(seed), 1, 4)
        lane = (tram - np.floor(tram)) * 15.0
        value = 0.94 + 0.10 * row
        if abs(lane - 6.6) < 0.25 or abs(lane - 8.4) < 0.25:
            value *= 0.78
        # Lodged and wet places.
        spot = _noise(x * 0.06 + n3 * 0.3, y * 0.06, int(seed))
        if spot > 0.28:
            value *= 0.84
    elif material == 9:
        r, g, b = 74.0 + 30 * leaf, 72.0 + 10 * leaf, 44.0
        value = 1 + 0.5 * n1 + 0.45 * n2 + 0.4 * n3 + 0.35 * grain
    elif material == 10:
        r, g, b = 58.0, 78.0, 78.0
        ripple = _noise(along * 0.5 + n3, across * 1.9, 31)
        value = 1 + 0.07 * ripple + 0.16 * n3 + 0.26 * n4 + 0.05 * grain
        weed = _noise(x * 0.11, y * 0.11, 32)
        if weed > 0.22:
            g += 16.0 * min(1.0, (weed - 0.22) * 8)
    elif material == 12:
        r, g, b = 164.0, 88.0, 70.0
        value = 1 + 0.14 * n1 + 0.12 * n3 + 0.14 * grain
    elif material == 13:
        r, g, b = 158.0, 150.0, 140.0
        k = np.floor(across / 0.45)
        i = np.floor(along / 0.7 + 0.5 * (k - 2 * np.floor(k / 2)))
        value = 1 + 0.30 * (_hash(int(i), int(k), 41) - 0.5) + 0.12 * n1 + 0.22 * n3 + 0.1 * grain
    elif material == 14:
        r, g, b = 88.0, 92.0, 54.0
        clump = _noise(x * 1.7, y * 1.7, 51)
        value = 1 + 0.6 * clump + 0.4 * n1 + 0.3 * n3
        colour = _hash(int(np.floor(x * 1.3 + n2)), int(np.floor(y * 1.3 + n1)), 52)
        if colour > 0.93:
            r, g, b = 186.0, 110.0, 120.0
        elif colour > 0.88:
            r, g, b = 196.0, 178.0, 84.0
        elif clump < -0.22:
            r, g, b = 112.0, 90.0, 70.0
    elif material == 15:
        r, g, b = 176.0, 172.0, 164.0
        i, j = np.floor(along / 4.2), np.floor(across / 4.2)
        value = 1 + 0.14 * (_hash(int(i), int(j), 61) - 0.5) + 0.16 * n1 + 0.24 * n3 + 0.16 * n4
        value += 0.14 * grain
        if along / 4.2 - i < 0.03 or across / 4.2 - j < 0.03:
            value *= 0.72
        if _noise(x * 0.3, y * 0.3, 62) > 0.34:
            value *= 0.78
    elif material == 16:
        r, g, b = 190.0, 188.0, 182.0
        value = 1 + 0.2 * n1 + 0.12 * n3
    elif material == 17:
        r, g, b = 138.0, 130.0, 110.0
        value = 1 + 0.45 * n1 + 0.3 * n2 + 0.3 * grain
        if n2 + 0.7 * n3 > 0.08:
            r, g, b = 96.0, 104.0, 58.0
    else:
        r, g, b = 84.0, 168.0, 196.0
        value = 1 + 0.12 * _noise(x * 2 + n2, y * 2, 71)
    rgb[0], rgb[1], rgb[2] = r * value, g * value, b * value


@njit(cache=True, nogil=True, fastmath=True)
def paint_ground(  # type: ignore[no-untyped-def]
    region, material, tint, shape, west, north, gsd,
    heights, slope_e, slope_n, spacing, half,
    ceiling, ambient, light_west, light_north, light_gsd, sun, sun_rgb, sky_rgb, season, out,
):  # fmt: skip
    """Colour and light of a ground window: region ids (H, W) to out (H, W, 3) uint8."""
    rgb = np.empty(3)
    for i in range(region.shape[0]):
        y = north - (i + 0.5) * gsd
        for j in range(region.shape[1]):
            x = west + (j + 0.5) * gsd
            k = region[i, j]
            _ground_albedo(
                material[k], x, y, shape[k, 0], shape[k, 1], shape[k, 2],
                season[0], season[1], season[2], rgb,
            )  # fmt: skip
            u, v = (x + half) / spacing, (y + half) / spacing
            z = _bilinear(heights, u, v)
            ge, gn = _bilinear(slope_e, u, v), _bilinear(slope_n, u, v)
            inverse = 1.0 / np.sqrt(1 + ge * ge + gn * gn)
            cosine = max(0.0, (sun[2] - ge * sun[0] - gn * sun[1]) * inverse)
            lu, lv = (x - light_west) / light_gsd - 0.5, (light_north - y) / light_gsd - 0.5
            shadow = min(max((_bilinear(ceiling, lu, lv) - z - 0.25) * 2.2, 0.0), 1.0)
            sky = _bilinear(ambient, lu, lv)
            direct = cosine * (1 - shadow)
            for c in range(3):
                light = sky_rgb[c] * sky + sun_rgb[c] * direct
                out[i, j, c] = _byte(rgb[c] * tint[k, c] * light)


@njit(cache=True, nogil=True, fastmath=True)
def _glass(s, z, pane, rgb):  # type: ignore[no-untyped-def]
    """A window pane: dark, with a reflection that depends on the pane."""
    tone = 34.0 + 60.0 * pane * pane + 26.0 * _noise(s * 0.9, z * 0.9, 81)
    rgb[0], rgb[1], rgb[2] = tone * 0.92, tone * 1.02, tone * 1.14


@njit(cache=True, nogil=True, fastmath=True)
def _facade_albedo(s, height, width, eaves, base, accent, p, seed, rgb):  # type: ignore[no-untyped-def]
    """Colour at s metres from the wall's left end and `height` metres above the ground floor.

    p: floor height, window spacing, window width, window height, sill, style.
    """
    floor_h, pitch, win_w, win_h, sill, style = p[0], p[1], p[2], p[3], p[4], int(p[5])
    grain = _noise(s * 5, height * 5, seed)
    blotch = _noise(s * 0.5, height * 0.5, seed + 1)
    streak = _noise(s * 2.2, height * 0.12, seed + 2)
    value = 1 + 0.12 * grain + 0.14 * blotch + 0.12 * streak
    r, g, b = base[0], base[1], base[2]
    if style == 2:  # corrugated sheet
        value *= 1 + 0.07 * np.sin(2 * np.pi * s / 0.9)
        if abs(s / 6.0 - np.floor(s / 6.0)) * 6.0 < 0.16:
            value *= 0.82
        if height > eaves - 0.9:
            r, g, b = accent[0], accent[1], accent[2]
    elif style == 5:  # planks
        plank = np.floor(s / 0.3)
        value *= 1 + 0.34 * (_hash(int(plank), 1, seed) - 0.5)
    elif style == 7:  # brick
        row = np.floor(height / 0.26)
        brick = np.floor(s / 0.5 + 0.5 * (row - 2 * np.floor(row / 2)))
        value *= 1 + 0.34 * (_hash(int(brick), int(row), seed) - 0.5)
    if height < 0.55 and style != 2:
        r, g, b = r * 0.62, g * 0.62, b * 0.64
    value *= 0.90 + 0.10 * _step(height, 0.0, 2.5)
    if eaves - height < 0.35 and height < eaves and style != 2:
        value *= 0.72
    rgb[0], rgb[1], rgb[2] = r * value, g * value, b * value
    if style == 6 or height < 0.0:
        return

    count = int((width - 0.8) / pitch)
    if count < 1:
        if width < 2.2:
            return
        count = 1
    margin = (width - count * pitch) / 2
    k = int(np.floor((s - margin) / pitch))
    floor = int(np.floor(height / floor_h))
    if k < 0 or k >= count or floor < 0:
        return
    local = s - margin - (k + 0.5) * pitch
    up = height - floor * floor_h - sill
    top = (floor + 1) * floor_h > eaves + 0.35
    pane = _hash(k, floor, seed + 3)
    if top:
        # In the gable: one small window in the middle.
        if style not in (0, 5, 7) or abs(k - (count - 1) / 2) > 0.6:
            return
    if style == 2:
        if floor == 0 and pane > 0.72 and abs(local) < min(1.9, pitch / 2 - 0.1):
            if height < 3.6:
                line = abs(height / 0.55 - np.floor(height / 0.55)) < 0.14
                dark = 0.78 if line else 1.0
                rgb[0], rgb[1], rgb[2] = 168 * dark, 170 * dark, 172 * dark
            return
        if abs(height - eaves + 1.9) < 0.55 and abs(local) < pitch / 2 - 0.25:
            _glass(s, height, pane, rgb)
        return
    if style == 4:  # ribbon windows
        if 0 < up < win_h:
            _glass(s, height, _hash(int(np.floor(s / 1.5)), floor, seed + 4), rgb)
            if abs(s / 1.5 - np.floor(s / 1.5)) < 0.08:
                rgb[0], rgb[1], rgb[2] = 176.0, 178.0, 180.0
        return
    if style == 3:  # tall arched windows
        tall = eaves * 0.55
        arch = height - (sill + tall)
        inside = abs(local) < win_w / 2 and height > sill
        if inside and (arch < 0 or arch * arch + local * local < win_w * win_w / 4):
            _glass(s, height, 0.2 * pane, rgb)
            if abs(local) < 0.06:
                rgb[0], rgb[1], rgb[2] = 120.0, 116.0, 110.0
        elif abs(local) < win_w / 2 + 0.2 and height > sill - 0.2 and arch < win_w / 2 + 0.2:
            rgb[0], rgb[1], rgb[2] = rgb[0] * 1.1, rgb[1] * 1.1, rgb[2] * 1.08
        return
    door = floor == 0 and (k == int(seed % 7) % count) and style != 5
    if door:
        if abs(local) < 0.55 and height < 2.15:
            rgb[0], rgb[1], rgb[2] = accent[0] * 0.8, accent[1] * 0.8, accent[2] * 0.8
            if abs(local) > 0.45 or height > 2.05:
                rgb[0], rgb[1], rgb[2] = 210.0, 206.0, 198.0
        return
    if style == 1 and (k % 3 == 1) and floor > 0:  # balcony: recess, rail, dark door
        if abs(local) < pitch / 2 - 0.1 and 0 < height - floor * floor_h < 2.3:
            if height - floor * floor_h < 1.0:
                rgb[0], rgb[1], rgb[2] = accent[0], accent[1], accent[2]
            else:
                _glass(s, height, 0.5 * pane, rgb)
            return
    if abs(local) < win_w / 2 and 0 < up < win_h:
        if abs(local) > win_w / 2 - 0.09 or up < 0.09 or up > win_h - 0.09 or abs(local) < 0.05:
            rgb[0], rgb[1], rgb[2] = 216.0, 212.0, 204.0
        elif pane > 0.82 and up > win_h * 0.45:
            rgb[0], rgb[1], rgb[2] = 190.0, 184.0, 170.0  # blind half down
        else:
            _glass(s, height, pane, rgb)
    elif 0 < up < win_h and abs(local) < win_w * 1.02 and style == 0 and seed % 3 != 0:
        slat = 0.82 if abs(up / 0.2 - np.floor(up / 0.2)) < 0.4 else 1.0
        rgb[0], rgb[1], rgb[2] = accent[0] * slat, accent[1] * slat, accent[2] * slat
    elif -0.14 < up <= 0 and abs(local) < win_w / 2 + 0.1:
        rgb[0], rgb[1], rgb[2] = 196.0, 192.0, 186.0


@njit(cache=True, nogil=True, fastmath=True)
def _roof_albedo(cover, s, t, width, length, base, accent, p, seed, leaf, dryness, rgb):  # type: ignore[no-untyped-def]
    """Colour of a roof texel, s along the eave and t down the slope, in metres."""
    n1 = _noise(s * 3.3, t * 3.3, seed)
    n2 = _noise(s * 0.9, t * 0.9, seed + 1)
    n3 = _noise(s * 0.24, t * 0.24, seed + 2)
    run = _noise(s * 1.4, t * 0.16, seed + 3)
    r, g, b = base[0], base[1], base[2]
    value = 1.0
    if cover == 2 or cover == 9:
        size = 0.38 if cover == 2 else 0.5
        row = np.floor(t / size)
        column = np.floor(s / (size * 0.9) + 0.5 * (row - 2 * np.floor(row / 2)))
        tile = _hash(int(column), int(row), seed) - 0.5
        value = 1 + 0.30 * tile + 0.10 * n1 + 0.22 * n2 + 0.24 * n3 + 0.18 * run
        if t / size - row > 0.72:
            value *= 0.86
        moss = n2 + n3 + 0.5 * run + 0.25 * (t / max(length, 1.0) - 0.5)
        if moss > 0.38:
            m = min(1.0, (moss - 0.38) * 4) * 0.6
            r, g, b = r + m * (92 - r), g + m * (96 - g), b + m * (72 - b)
        if t < 0.28:
            value *= 1.16
        if p[0] > 0 and 0.9 < t < 0.9 + 1.4 * p[0]:  # skylights
            pitch = 3.1
            k = np.floor((s - 1.2) / pitch)
            local = s - 1.2 - (k + 0.5) * pitch
            if abs(local) < 0.45 and s > 1.2 and s < width - 1.2 and _hash(int(k), 8, seed) > 0.55:
                if abs(local) > 0.36 or t < 1.0:
                    r, g, b, value = 120.0, 118.0, 116.0, 1.0
                else:
                    _glass(s, t, 0.9 * _hash(int(k), 9, seed), rgb)
                    return
        if p[1] > 0 and t > 0.7 and t < length - 1.0:  # solar panels
            left, right = p[1] * width, p[2] * width
            rows = np.floor((length - 1.7) / 1.75)
            if left < s < right and t - 0.7 < rows * 1.75:
                us, ut = (s - left) / 1.05, (t - 0.7) / 1.75
                edge = min(us - np.floor(us), ut - np.floor(ut))
                tone = 1 + 0.25 * (_hash(int(np.floor(us)), int(np.floor(ut)), seed) - 0.5)
                rgb[0], rgb[1], rgb[2] = 38.0 * tone, 46.0 * tone, 74.0 * tone
                if edge < 0.09:
                    rgb[0], rgb[1], rgb[2] = 150.0, 154.0, 160.0
                return
    elif cover == 3:
        grain = _hash(int(np.floor(s * 8)), int(np.floor(t * 8)), seed) - 0.5
        value = 1 + 0.30 * grain + 0.16 * n1 + 0.16 * n2 + 0.30 * n3
        if n2 + 1.3 * n3 > 0.62:
            r, g, b = 96.0, 100.0, 74.0
        edge = min(min(s, width - s), min(t, length - t))
        if edge < 0.6:
            value *= 0.82
    elif cover == 4:
        sheet = np.floor(s / 1.05)
        value = 1 + 0.16 * (_hash(int(sheet), int(np.floor(t / 7.0)), seed) - 0.5)
        value += 0.14 * n1 + 0.18 * n2 + 0.34 * n3
        if s / 1.05 - sheet < 0.09:
            value *= 0.80
        if n3 + 0.4 * n2 > 0.36:
            value *= 0.74  # standing water
        if _noise(s * 0.3, t * 0.3, seed + 7) > 0.36:
            r, g, b = r * 1.35, g * 1.35, b * 1.33  # newer patch
    elif cover == 5:
        seam = s / 0.6
        value = 1 + 0.08 * n1 + 0.10 * n2 + 0.14 * n3 + 0.24 * run
        if seam - np.floor(seam) < 0.2:
            value *= 0.86
        panel = np.floor(s / 6.0)
        value *= 1 + 0.12 * (_hash(int(panel), int(np.floor(t / 12.0)), seed) - 0.5)
        if p[0] > 0:
            us = s / 6.0 - panel
            ut = t / 8.0 - np.floor(t / 8.0)
            if 0.35 < us < 0.65 and 0.25 < ut < 0.75 and 2 < t < length - 2:
                r, g, b = 206.0, 210.0, 206.0  # light strips
                value = 1 + 0.2 * n2
        rust = n3 + run
        if rust > 0.5:
            r, g, b = r * 0.9 + 14, g * 0.82, b * 0.74
    elif cover == 6:
        r, g, b = 112.0 + 50 * dryness, 112.0 + 20 * dryness, 66.0
        value = 1 + 0.4 * n1 + 0.35 * n2 + 0.3 * n3
        if n2 - n3 > 0.4:
            r, g, b = 150.0, 96.0, 84.0
        edge = min(min(s, width - s), min(t, length - t))
        if edge < 0.5:
            r, g, b, value = 160.0, 156.0, 148.0, 1 + 0.3 * n1
    elif cover == 8:
        value = 1 + 0.2 * n1 + 0.2 * n3
        us = s / 2.5 - np.floor(s / 2.5)
        band = t / 16.0 - np.floor(t / 16.0)
        if us < 0.06 and (band < 0.31 or band > 0.69):
            r, g, b = 220.0, 220.0, 214.0
    elif cover == 7:
        us, ut = s / 1.2 - np.floor(s / 1.2), t / 1.2 - np.floor(t / 1.2)
        if us < 0.1 or ut < 0.1:
            r, g, b = 180.0, 182.0, 180.0
        else:
            _glass(s, t, _hash(int(s / 1.2), int(t / 1.2), seed), rgb)
            return
    elif cover == 10:
        value = 1 + 0.6 * n1 + 0.4 * n2 + 0.2 * n3
    else:
        value = 1 + 0.16 * n1 + 0.16 * n2 + 0.12 * n3
    rgb[0], rgb[1], rgb[2] = r * value, g * value, b * value


@njit(cache=True, nogil=True, fastmath=True)
def paint_surface(  # type: ignore[no-untyped-def]
    cover, origin, right, down, normal, gsd, width, length, base, accent, p, floor_z, eaves_z,
    seed, ceiling, ambient, light_west, light_north, light_gsd, sun, sun_rgb, sky_rgb, season, out,
):  # fmt: skip
    """Colour and light of a planar chart: texel (i, j) lies at origin + right * s + down * t."""
    rgb = np.empty(3)
    cosine = max(0.0, normal[0] * sun[0] + normal[1] * sun[1] + normal[2] * sun[2])
    horizontal = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    wall = horizontal > 0.9
    openness = 0.62 + 0.38 * normal[2]
    # Walls look for their light a little in front of themselves.
    ahead = 0.7 if wall else 0.0
    for i in range(out.shape[0]):
        t = (i + 0.5) * gsd
        for j in range(out.shape[1]):
            s = (j + 0.5) * gsd
            x = origin[0] + right[0] * s + down[0] * t + normal[0] * ahead
            y = origin[1] + right[1] * s + down[1] * t + normal[1] * ahead
            z = origin[2] + right[2] * s + down[2] * t
            if cover == 1:
                _facade_albedo(s, z - floor_z, width, eaves_z - floor_z, base, accent, p, seed, rgb)
            else:
                _roof_albedo(
                    cover, s, t, width, length, base, accent, p, seed, season[2], season[0], rgb
                )
            lu, lv = (x - light_west) / light_gsd - 0.5, (light_north - y) / light_gsd - 0.5
            shadow = min(max((_bilinear(ceiling, lu, lv) - z - 0.35) * 1.6, 0.0), 1.0)
            sky = openness
            if wall:
                sky *= 0.62 + 0.38 * _step(z - floor_z, -0.5, 4.0)
            direct = cosine * (1 - shadow)
            # Light that the ground throws back up at walls.
            bounce = 0.10 * horizontal * sun[2]
            for c in range(3):
                light = sky_rgb[c] * sky + sun_rgb[c] * (direct + bounce)
                out[i, j, c] = _byte(rgb[c] * light)


@njit(cache=True, nogil=True, fastmath=True)
def paint_crown(base, conifer, seed, shade, sun, sun_rgb, sky_rgb, out):  # type: ignore[no-untyped-def]
    """A crown seen from above, (n, n, 3): azimuthal about the trunk, edge = underside."""
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
                clump = 0.30 * np.sin(radius * 19 + 2.2 * _noise(angle * 2.5, radius * 3, seed))
                clump += 0.5 * _noise(angle * 6, radius * 7, seed + 1)
            else:
                clump = 0.75 * _noise(dx * 4.2, dy * 4.2, seed)
                clump += 0.55 * _noise(dx * 9.5, dy * 9.5, seed + 1)
            fine = _noise(dx * 0.45 * n, dy * 0.45 * n, seed + 2)
            nx += 0.7 * _noise(dx * 5 + 9, dy * 5, seed + 4)
            ny += 0.7 * _noise(dx * 5, dy * 5 + 9, seed + 5)
            cosine = max(0.0, (nx * sun[0] + ny * sun[1] + nz * sun[2]) / 1.1)
            gap = 1.0
            if clump + 0.5 * fine < -0.38:
                gap = 0.5
            value = (1 + 0.55 * clump + 0.5 * fine) * gap
            sky = 0.55 + 0.45 * max(0.0, nz)
            hue = _noise(dx * 2.1, dy * 2.1, seed + 6)
            for c in range(3):
                light = sky_rgb[c] * sky + sun_rgb[c] * (cosine * (1 - shade) + 0.08)
                tone = base[c] * (1 + (0.2 * hue if c == 0 else (0.05 * hue if c == 1 else 0)))
                out[i, j, c] = _byte(tone * value * light)


def new_image(height: int, width: int) -> Image:
    """An empty RGB image."""
    return np.empty((height, width, 3), np.uint8)
