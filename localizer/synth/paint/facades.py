"""Painting the flat charts of buildings and hedges: facades, roofs, glass."""

# ruff: noqa: PLR0912, PLR0915, PLR0911, PLW3301, PLR1714, SIM102 (kernels branch over materials)

from __future__ import annotations

import numpy as np
from numba import njit

from localizer.synth.paint.covers import (
    Cover,
    FacadeStyle,
    as_byte,
    bilinear,
    hash01,
    noise,
    smooth_step,
)


@njit(cache=True, nogil=True, fastmath=True)
def _glass(s, z, pane, rgb):  # type: ignore[no-untyped-def]
    """A window pane: dark, with a reflection that depends on the pane."""
    tone = 34.0 + 60.0 * pane * pane + 26.0 * noise(s * 0.9, z * 0.9, 81)
    rgb[0], rgb[1], rgb[2] = tone * 0.92, tone * 1.02, tone * 1.14


@njit(cache=True, nogil=True, fastmath=True)
def _openings(s, height, width, eaves, accent, p, seed, rgb):  # type: ignore[no-untyped-def]
    """Windows, doors, gates and balconies over the wall's colour; arguments as of the facade."""
    floor_h, pitch, win_w, win_h, sill, style = p[0], p[1], p[2], p[3], p[4], int(p[5])
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
    pane = hash01(k, floor, seed + 3)
    if top:
        # In the gable: one small window in the middle.
        if (
            style not in (FacadeStyle.HOUSE, FacadeStyle.BARN, FacadeStyle.BRICK)
            or abs(k - (count - 1) / 2) > 0.6
        ):
            return
    if style == FacadeStyle.HALL:
        if floor == 0 and pane > 0.72 and abs(local) < min(1.9, pitch / 2 - 0.1):
            if height < 3.6:
                line = abs(height / 0.55 - np.floor(height / 0.55)) < 0.14
                dark = 0.78 if line else 1.0
                rgb[0], rgb[1], rgb[2] = 168 * dark, 170 * dark, 172 * dark
            return
        if abs(height - eaves + 1.9) < 0.55 and abs(local) < pitch / 2 - 0.25:
            _glass(s, height, pane, rgb)
        return
    if style == FacadeStyle.OFFICE:  # ribbon windows
        if 0 < up < win_h:
            _glass(s, height, hash01(int(np.floor(s / 1.5)), floor, seed + 4), rgb)
            if abs(s / 1.5 - np.floor(s / 1.5)) < 0.08:
                rgb[0], rgb[1], rgb[2] = 176.0, 178.0, 180.0
        return
    if style == FacadeStyle.CHURCH:  # tall arched windows
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
    door = floor == 0 and (k == int(seed % 7) % count) and style != FacadeStyle.BARN
    if door:
        if abs(local) < 0.55 and height < 2.15:
            rgb[0], rgb[1], rgb[2] = accent[0] * 0.8, accent[1] * 0.8, accent[2] * 0.8
            if abs(local) > 0.45 or height > 2.05:
                rgb[0], rgb[1], rgb[2] = 210.0, 206.0, 198.0
        return
    if (
        style == FacadeStyle.APARTMENT and (k % 3 == 1) and floor > 0
    ):  # balcony: recess, rail, dark door
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
    elif (
        0 < up < win_h
        and abs(local) < win_w * 1.02
        and style == FacadeStyle.HOUSE
        and seed % 3 != 0
    ):
        slat = 0.82 if abs(up / 0.2 - np.floor(up / 0.2)) < 0.4 else 1.0
        rgb[0], rgb[1], rgb[2] = accent[0] * slat, accent[1] * slat, accent[2] * slat
    elif -0.14 < up <= 0 and abs(local) < win_w / 2 + 0.1:
        rgb[0], rgb[1], rgb[2] = 196.0, 192.0, 186.0


@njit(cache=True, nogil=True, fastmath=True)
def _facade_albedo(s, height, width, eaves, base, accent, p, seed, rgb):  # type: ignore[no-untyped-def]
    """Colour at s metres from the wall's left end and `height` metres above the ground floor.

    p: floor height, window spacing, window width, window height, sill, style.
    """
    style = int(p[5])
    grain = noise(s * 5, height * 5, seed)
    blotch = noise(s * 0.5, height * 0.5, seed + 1)
    streak = noise(s * 2.2, height * 0.12, seed + 2)
    value = 1 + 0.12 * grain + 0.14 * blotch + 0.12 * streak
    r, g, b = base[0], base[1], base[2]
    if style == FacadeStyle.HALL:  # corrugated sheet
        value *= 1 + 0.07 * np.sin(2 * np.pi * s / 0.9)
        if abs(s / 6.0 - np.floor(s / 6.0)) * 6.0 < 0.16:
            value *= 0.82
        if height > eaves - 0.9:
            r, g, b = accent[0], accent[1], accent[2]
    elif style == FacadeStyle.BARN:  # planks
        plank = np.floor(s / 0.3)
        value *= 1 + 0.34 * (hash01(int(plank), 1, seed) - 0.5)
    elif style == FacadeStyle.BRICK:  # brick
        row = np.floor(height / 0.26)
        brick = np.floor(s / 0.5 + 0.5 * (row - 2 * np.floor(row / 2)))
        value *= 1 + 0.34 * (hash01(int(brick), int(row), seed) - 0.5)
    if height < 0.55 and style != FacadeStyle.HALL:
        r, g, b = r * 0.62, g * 0.62, b * 0.64
    value *= 0.90 + 0.10 * smooth_step(height, 0.0, 2.5)
    if eaves - height < 0.35 and height < eaves and style != FacadeStyle.HALL:
        value *= 0.72
    rgb[0], rgb[1], rgb[2] = r * value, g * value, b * value
    if style != FacadeStyle.BLANK and height >= 0.0:
        _openings(s, height, width, eaves, accent, p, seed, rgb)


@njit(cache=True, nogil=True, fastmath=True)
def _fittings(s, t, width, length, p, seed, rgb):  # type: ignore[no-untyped-def]
    """Paint a skylight or solar panel of a tiled roof into rgb, if one is at this point; returns
    whether.

    s, t: metres along the eaves and down the slope; width, length: the roof's, in metres. p: rows
    of skylights, then the panels' left and right end as shares of the width.
    """
    frame = False
    if p[0] > 0 and 0.9 < t < 0.9 + 1.4 * p[0]:
        pitch = 3.1
        k = np.floor((s - 1.2) / pitch)
        local = s - 1.2 - (k + 0.5) * pitch
        if abs(local) < 0.45 and s > 1.2 and s < width - 1.2 and hash01(int(k), 8, seed) > 0.55:
            frame = abs(local) > 0.36 or t < 1.0
            if not frame:
                _glass(s, t, 0.9 * hash01(int(k), 9, seed), rgb)
                return True
    if p[1] > 0 and t > 0.7 and t < length - 1.0:
        left, right = p[1] * width, p[2] * width
        rows = np.floor((length - 1.7) / 1.75)
        if left < s < right and t - 0.7 < rows * 1.75:
            us, ut = (s - left) / 1.05, (t - 0.7) / 1.75
            edge = min(us - np.floor(us), ut - np.floor(ut))
            tone = 1 + 0.25 * (hash01(int(np.floor(us)), int(np.floor(ut)), seed) - 0.5)
            rgb[0], rgb[1], rgb[2] = 38.0 * tone, 46.0 * tone, 74.0 * tone
            if edge < 0.09:
                rgb[0], rgb[1], rgb[2] = 150.0, 154.0, 160.0
            return True
    if frame:
        rgb[0], rgb[1], rgb[2] = 120.0, 118.0, 116.0
    return frame


@njit(cache=True, nogil=True, fastmath=True)
def _tiles(cover, s, t, length, r, g, b, seed, n1, n2, n3, run):  # type: ignore[no-untyped-def]
    """Tiles or slates, with moss."""
    size = 0.38 if cover == Cover.TILES else 0.5
    row = np.floor(t / size)
    column = np.floor(s / (size * 0.9) + 0.5 * (row - 2 * np.floor(row / 2)))
    tile = hash01(int(column), int(row), seed) - 0.5
    value = 1 + 0.30 * tile + 0.10 * n1 + 0.22 * n2 + 0.24 * n3 + 0.18 * run
    if t / size - row > 0.72:
        value *= 0.86
    moss = n2 + n3 + 0.5 * run + 0.25 * (t / max(length, 1.0) - 0.5)
    if moss > 0.38:
        m = min(1.0, (moss - 0.38) * 4) * 0.6
        r, g, b = r + m * (92 - r), g + m * (96 - g), b + m * (72 - b)
    if t < 0.28:
        value *= 1.16
    return r, g, b, value


@njit(cache=True, nogil=True, fastmath=True)
def _metal(s, t, length, r, g, b, p, seed, n1, n2, n3, run):  # type: ignore[no-untyped-def]
    """Seamed sheets, with light strips where p[0] is set, and rust."""
    seam = s / 0.6
    value = 1 + 0.08 * n1 + 0.10 * n2 + 0.14 * n3 + 0.24 * run
    if seam - np.floor(seam) < 0.2:
        value *= 0.86
    panel = np.floor(s / 6.0)
    value *= 1 + 0.12 * (hash01(int(panel), int(np.floor(t / 12.0)), seed) - 0.5)
    if p[0] > 0:
        us = s / 6.0 - panel
        ut = t / 8.0 - np.floor(t / 8.0)
        if 0.35 < us < 0.65 and 0.25 < ut < 0.75 and 2 < t < length - 2:
            r, g, b = 206.0, 210.0, 206.0  # light strips
            value = 1 + 0.2 * n2
    rust = n3 + run
    if rust > 0.5:
        r, g, b = r * 0.9 + 14, g * 0.82, b * 0.74
    return r, g, b, value


@njit(cache=True, nogil=True, fastmath=True)
def _roof_albedo(cover, s, t, width, length, base, accent, p, seed, leaf, dryness, rgb):  # type: ignore[no-untyped-def]
    """Colour of a roof texel, s along the eave and t down the slope, in metres."""
    n1 = noise(s * 3.3, t * 3.3, seed)
    n2 = noise(s * 0.9, t * 0.9, seed + 1)
    n3 = noise(s * 0.24, t * 0.24, seed + 2)
    run = noise(s * 1.4, t * 0.16, seed + 3)
    r, g, b = base[0], base[1], base[2]
    value = 1.0
    if cover == Cover.TILES or cover == Cover.SLATE:
        r, g, b, value = _tiles(cover, s, t, length, r, g, b, seed, n1, n2, n3, run)
        if _fittings(s, t, width, length, p, seed, rgb):
            return
    elif cover == Cover.GRAVEL:
        grain = hash01(int(np.floor(s * 8)), int(np.floor(t * 8)), seed) - 0.5
        value = 1 + 0.30 * grain + 0.16 * n1 + 0.16 * n2 + 0.30 * n3
        if n2 + 1.3 * n3 > 0.62:
            r, g, b = 96.0, 100.0, 74.0
        edge = min(min(s, width - s), min(t, length - t))
        if edge < 0.6:
            value *= 0.82
    elif cover == Cover.BITUMEN:
        sheet = np.floor(s / 1.05)
        value = 1 + 0.16 * (hash01(int(sheet), int(np.floor(t / 7.0)), seed) - 0.5)
        value += 0.14 * n1 + 0.18 * n2 + 0.34 * n3
        if s / 1.05 - sheet < 0.09:
            value *= 0.80
        if n3 + 0.4 * n2 > 0.36:
            value *= 0.74  # standing water
        if noise(s * 0.3, t * 0.3, seed + 7) > 0.36:
            r, g, b = r * 1.35, g * 1.35, b * 1.33  # newer patch
    elif cover == Cover.METAL:
        r, g, b, value = _metal(s, t, length, r, g, b, p, seed, n1, n2, n3, run)
    elif cover == Cover.GREEN:
        r, g, b = 112.0 + 50 * dryness, 112.0 + 20 * dryness, 66.0
        value = 1 + 0.4 * n1 + 0.35 * n2 + 0.3 * n3
        if n2 - n3 > 0.4:
            r, g, b = 150.0, 96.0, 84.0
        edge = min(min(s, width - s), min(t, length - t))
        if edge < 0.5:
            r, g, b, value = 160.0, 156.0, 148.0, 1 + 0.3 * n1
    elif cover == Cover.DECK:
        value = 1 + 0.2 * n1 + 0.2 * n3
        us = s / 2.5 - np.floor(s / 2.5)
        band = t / 16.0 - np.floor(t / 16.0)
        if us < 0.06 and (band < 0.31 or band > 0.69):
            r, g, b = 220.0, 220.0, 214.0
    elif cover == Cover.GLASS:
        us, ut = s / 1.2 - np.floor(s / 1.2), t / 1.2 - np.floor(t / 1.2)
        if us < 0.1 or ut < 0.1:
            r, g, b = 180.0, 182.0, 180.0
        else:
            _glass(s, t, hash01(int(s / 1.2), int(t / 1.2), seed), rgb)
            return
    elif cover == Cover.HEDGE:
        value = 1 + 0.6 * n1 + 0.4 * n2 + 0.2 * n3
    else:
        value = 1 + 0.16 * n1 + 0.16 * n2 + 0.12 * n3
    rgb[0], rgb[1], rgb[2] = r * value, g * value, b * value


@njit(cache=True, nogil=True, fastmath=True)
def paint_surface(  # type: ignore[no-untyped-def]
    cover, origin, right, down, normal, gsd, width, length, base, accent, p, floor_z, eaves_z,
    seed, ceiling, ambient, light_west, light_north, light_gsd, sun, sun_rgb, sky_rgb, season, out,
):  # fmt: skip
    """Paint a planar chart in its light: out's texel (i, j) is origin + right * s + down * t."""
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
            if cover == Cover.FACADE:
                _facade_albedo(s, z - floor_z, width, eaves_z - floor_z, base, accent, p, seed, rgb)
            else:
                _roof_albedo(
                    cover, s, t, width, length, base, accent, p, seed, season[2], season[0], rgb
                )
            lu, lv = (x - light_west) / light_gsd - 0.5, (light_north - y) / light_gsd - 0.5
            shadow = min(max((bilinear(ceiling, lu, lv) - z - 0.35) * 1.6, 0.0), 1.0)
            sky = openness
            if wall:
                sky *= 0.62 + 0.38 * smooth_step(z - floor_z, -0.5, 4.0)
            direct = cosine * (1 - shadow)
            # Light that the ground throws back up at walls.
            bounce = 0.10 * horizontal * sun[2]
            for c in range(3):
                light = sky_rgb[c] * sky + sun_rgb[c] * (direct + bounce)
                out[i, j, c] = as_byte(rgb[c] * light)
