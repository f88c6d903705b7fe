"""Painting the ground: a colour for each material, lit by the window's light."""

# ruff: noqa: PLR0912, PLR0915, PLR1714 (kernels branch over materials)

from __future__ import annotations

import numpy as np
from numba import njit

from localizer.synth.paint.covers import as_byte, bilinear, hash01, noise, smooth_step
from localizer.synth.paint.ground_plan import Material


@njit(cache=True, nogil=True, fastmath=True)
def _grass(material, x, y, along, across, seed, dryness, n1, n2, n3, n4, grain):  # type: ignore[no-untyped-def]
    """Meadow, lawn and sports turf: tufts, dry patches, mowing stripes, molehills."""
    if material == Material.MEADOW:
        r, g, b = 104.0, 112.0, 68.0
        rough = 1.0
    elif material == Material.LAWN:
        r, g, b = 96.0, 112.0, 68.0
        rough = 0.75
    else:
        r, g, b = 86.0, 114.0, 66.0
        rough = 0.45
    tuft = noise(x * 0.42 + 3 * n3, y * 0.42, 16)
    dry = min(max(dryness + 1.1 * n4 + 0.9 * n3 * rough + 0.5 * tuft - 0.1, 0.0), 1.0)
    if material == Material.TURF:
        dry *= 0.35
    r += dry * (172.0 - r)
    g += dry * (156.0 - g)
    b += dry * (104.0 - b)
    value = 1 + rough * (0.34 * n1 + 0.30 * n2 + 0.22 * tuft + 0.28 * grain) + 0.15 * n4
    if material == Material.LAWN:
        value *= 1 + 0.05 * np.sign(np.sin(across * 2 * np.pi / 1.9 + seed))
    if material == Material.TURF:
        value *= 1 + 0.09 * np.sign(np.sin(along * np.pi / 5.0 + seed))
    # Bare patches and molehills.
    if material == Material.MEADOW and n2 + tuft > 0.62:
        r, g, b = 128.0, 106.0, 78.0
    return r, g, b, value


@njit(cache=True, nogil=True, fastmath=True)
def _asphalt(x, y, along, across, seed, n1, n2, n3, n4, grain):  # type: ignore[no-untyped-def]
    """Patches, seams, cracks and stains."""
    r, g, b = 108.0, 107.0, 108.0
    patch = hash01(int(np.floor(along / 7.3 + n3)), int(np.floor(across / 3.1)), int(seed))
    value = 1 + 0.22 * n1 + 0.18 * n2 + 0.24 * n3 + 0.16 * n4 + 0.30 * grain
    if patch > 0.92:
        value *= 0.86
    elif patch < 0.05:
        value *= 1.10
    crack = abs(noise(x * 0.35 + 0.6 * n2, y * 0.35 + 0.5 * n1, 17))
    if crack < 0.012:
        value *= 0.68
    stain = noise(x * 0.55, y * 0.55, 18)
    if stain > 0.33:
        value *= 0.80
    return r, g, b, value


@njit(cache=True, nogil=True, fastmath=True)
def _field(material, x, y, across, spacing, seed, crop, n1, n2, n3, n4, grain):  # type: ignore[no-untyped-def]
    """A field in rows, from soil over green to grain, with tramlines."""
    wobble = 0.25 * n3 + 0.1 * n2
    phase = across / spacing + wobble / spacing
    row = 0.5 + 0.5 * np.cos(2 * np.pi * phase)
    # The same field ripens from soil over green to grain; each a little earlier or later.
    stage = crop + (
        0.45 if material == Material.GRAIN else (-0.5 if material == Material.SOIL else 0.0)
    )
    stage += 0.24 * (hash01(int(seed), 3, 7) - 0.5) + 0.12 * n4
    soil_v = 1 + 0.22 * n1 + 0.24 * n2 + 0.2 * n3 + 0.25 * grain
    sr, sg, sb = 136.0 * soil_v, 112.0 * soil_v, 86.0 * soil_v
    green = smooth_step(stage, 0.12, 0.42)
    ripe = smooth_step(stage, 0.72, 0.98)
    pr, pg, pb = 94.0, 114.0, 62.0
    hue = hash01(int(seed), 5, 9)
    pr, pg = pr + 24 * hue, pg + 12 * hue
    pr, pg, pb = pr + ripe * (194 - pr), pg + ripe * (168 - pg), pb + ripe * (104 - pb)
    plant_v = 1 + 0.30 * n1 + 0.26 * n2 + 0.26 * n3 + 0.18 * n4 + 0.25 * grain
    keep = green * min(1.0, 0.35 + 0.65 * row + 0.5 * green + 0.7 * n3)
    if green < 0.5:
        sr, sg, sb = sr * (0.86 + 0.2 * row), sg * (0.86 + 0.2 * row), sb * (0.86 + 0.2 * row)
    r = sr + keep * (pr * plant_v - sr)
    g = sg + keep * (pg * plant_v - sg)
    b = sb + keep * (pb * plant_v - sb)
    tram = across / 15.0 + hash01(int(seed), 1, 4)
    lane = (tram - np.floor(tram)) * 15.0
    value = 0.94 + 0.10 * row
    if abs(lane - 6.6) < 0.25 or abs(lane - 8.4) < 0.25:
        value *= 0.78
    # Lodged and wet places.
    spot = noise(x * 0.06 + n3 * 0.3, y * 0.06, int(seed))
    if spot > 0.28:
        value *= 0.84
    return r, g, b, value


@njit(cache=True, nogil=True, fastmath=True)
def _ground_albedo(material, x, y, angle, spacing, seed, dryness, crop, leaf, rgb):  # type: ignore[no-untyped-def]
    """Colour of one ground texel at ENU (x, y) into rgb (3,)."""
    n1 = noise(x * 3.1, y * 3.1, 11)
    n2 = noise(x * 0.83, y * 0.83, 12)
    n3 = noise(x * 0.19, y * 0.19, 13)
    n4 = noise(x * 0.037, y * 0.037, 14)
    grain = hash01(int(np.floor(x * 8)), int(np.floor(y * 8)), 15) - 0.5
    ca, sa = np.cos(angle), np.sin(angle)
    along, across = ca * x + sa * y, ca * y - sa * x
    if material == Material.MEADOW or material == Material.LAWN or material == Material.TURF:
        r, g, b, value = _grass(material, x, y, along, across, seed, dryness, n1, n2, n3, n4, grain)
    elif material == Material.ASPHALT:
        r, g, b, value = _asphalt(x, y, along, across, seed, n1, n2, n3, n4, grain)
    elif material == Material.PAVEMENT:  # slabs
        r, g, b = 164.0, 160.0, 152.0
        i, j = np.floor(x / 1.2), np.floor(y / 1.2)
        value = 1 + 0.16 * (hash01(int(i), int(j), 21) - 0.5) + 0.12 * n1 + 0.2 * n3 + 0.14 * grain
        if x / 1.2 - i < 0.09 or y / 1.2 - j < 0.09:
            value *= 0.80
    elif material == Material.MARKING:  # worn paint
        r, g, b = 226.0, 226.0, 220.0
        value = 1 + 0.25 * n1 + 0.15 * n3
        if n1 + 0.8 * n2 > 0.42:
            r, g, b = 120.0, 118.0, 116.0
    elif material == Material.GRAVEL:
        r, g, b = 172.0, 160.0, 138.0
        value = 1 + 0.30 * n1 + 0.16 * n2 + 0.22 * n3 + 0.34 * grain
        if n2 + n3 > 0.52:
            r, g, b = 104.0, 112.0, 66.0
    elif material == Material.CROP or material == Material.SOIL or material == Material.GRAIN:
        r, g, b, value = _field(material, x, y, across, spacing, seed, crop, n1, n2, n3, n4, grain)
    elif material == Material.FOREST:
        r, g, b = 74.0 + 30 * leaf, 72.0 + 10 * leaf, 44.0
        value = 1 + 0.5 * n1 + 0.45 * n2 + 0.4 * n3 + 0.35 * grain
    elif material == Material.WATER:
        r, g, b = 58.0, 78.0, 78.0
        ripple = noise(along * 0.5 + n3, across * 1.9, 31)
        value = 1 + 0.07 * ripple + 0.16 * n3 + 0.26 * n4 + 0.05 * grain
        weed = noise(x * 0.11, y * 0.11, 32)
        if weed > 0.22:
            g += 16.0 * min(1.0, (weed - 0.22) * 8)
    elif material == Material.TRACK:
        r, g, b = 164.0, 88.0, 70.0
        value = 1 + 0.14 * n1 + 0.12 * n3 + 0.14 * grain
    elif material == Material.PAVING:
        r, g, b = 158.0, 150.0, 140.0
        k = np.floor(across / 0.45)
        i = np.floor(along / 0.7 + 0.5 * (k - 2 * np.floor(k / 2)))
        value = 1 + 0.30 * (hash01(int(i), int(k), 41) - 0.5) + 0.12 * n1 + 0.22 * n3 + 0.1 * grain
    elif material == Material.BED:
        r, g, b = 88.0, 92.0, 54.0
        clump = noise(x * 1.7, y * 1.7, 51)
        value = 1 + 0.6 * clump + 0.4 * n1 + 0.3 * n3
        colour = hash01(int(np.floor(x * 1.3 + n2)), int(np.floor(y * 1.3 + n1)), 52)
        if colour > 0.93:
            r, g, b = 186.0, 110.0, 120.0
        elif colour > 0.88:
            r, g, b = 196.0, 178.0, 84.0
        elif clump < -0.22:
            r, g, b = 112.0, 90.0, 70.0
    elif material == Material.CONCRETE:
        r, g, b = 176.0, 172.0, 164.0
        i, j = np.floor(along / 4.2), np.floor(across / 4.2)
        value = 1 + 0.14 * (hash01(int(i), int(j), 61) - 0.5) + 0.16 * n1 + 0.24 * n3 + 0.16 * n4
        value += 0.14 * grain
        if along / 4.2 - i < 0.03 or across / 4.2 - j < 0.03:
            value *= 0.72
        if noise(x * 0.3, y * 0.3, 62) > 0.34:
            value *= 0.78
    elif material == Material.KERB:
        r, g, b = 190.0, 188.0, 182.0
        value = 1 + 0.2 * n1 + 0.12 * n3
    elif material == Material.BANK:
        r, g, b = 138.0, 130.0, 110.0
        value = 1 + 0.45 * n1 + 0.3 * n2 + 0.3 * grain
        if n2 + 0.7 * n3 > 0.08:
            r, g, b = 96.0, 104.0, 58.0
    else:
        r, g, b = 84.0, 168.0, 196.0
        value = 1 + 0.12 * noise(x * 2 + n2, y * 2, 71)
    rgb[0], rgb[1], rgb[2] = r * value, g * value, b * value


@njit(cache=True, nogil=True, fastmath=True)
def paint_albedo(region, material, tint, shape, west, north, gsd, season, moved, out):  # type: ignore[no-untyped-def]
    """Colour of a ground window without its light: region ids (H, W) to out (H, W, 3) float32 in
    0 to 255. moved: (2,) shift of the fine texture, metres.
    """
    rgb = np.empty(3)
    for i in range(region.shape[0]):
        y = north - (i + 0.5) * gsd
        for j in range(region.shape[1]):
            x = west + (j + 0.5) * gsd
            k = region[i, j]
            _ground_albedo(
                material[k], x + moved[0], y + moved[1], shape[k, 0], shape[k, 1], shape[k, 2],
                season[0], season[1], season[2], rgb,
            )  # fmt: skip
            for c in range(3):
                out[i, j, c] = rgb[c] * tint[k, c]


@njit(cache=True, nogil=True, fastmath=True)
def light_ground(  # type: ignore[no-untyped-def]
    albedo, west, north, gsd, heights, slope_e, slope_n, spacing, half,
    ceiling, ambient, light_west, light_north, light_gsd, sun, sun_rgb, sky_rgb, out,
):  # fmt: skip
    """A ground window in its light: albedo (H, W, 3) as of `paint_albedo` to out uint8."""
    for i in range(albedo.shape[0]):
        y = north - (i + 0.5) * gsd
        for j in range(albedo.shape[1]):
            x = west + (j + 0.5) * gsd
            u, v = (x + half) / spacing, (y + half) / spacing
            z = bilinear(heights, u, v)
            ge, gn = bilinear(slope_e, u, v), bilinear(slope_n, u, v)
            inverse = 1.0 / np.sqrt(1 + ge * ge + gn * gn)
            cosine = max(0.0, (sun[2] - ge * sun[0] - gn * sun[1]) * inverse)
            lu, lv = (x - light_west) / light_gsd - 0.5, (light_north - y) / light_gsd - 0.5
            shadow = min(max((bilinear(ceiling, lu, lv) - z - 0.25) * 2.2, 0.0), 1.0)
            sky = bilinear(ambient, lu, lv)
            direct = cosine * (1 - shadow)
            for c in range(3):
                light = sky_rgb[c] * sky + sun_rgb[c] * direct
                out[i, j, c] = as_byte(albedo[i, j, c] * light)
