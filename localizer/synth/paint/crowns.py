"""Painting tree crowns as they are seen from above."""

from __future__ import annotations

import numpy as np
from numba import njit

from localizer.synth.paint.noise import as_byte, noise


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
