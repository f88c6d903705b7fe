"""The surface that photogrammetry leaves of a training place: rounded, bumpy, without windows.

What the ground's texture becomes between two visits is `localizer.synth.visits.texture`.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from localizer.synth.heightfield.scene import BLOCK, LitScene, Prism
from localizer.synth.visits.noise import noise

_MESH_M = (0.3, 2.0)  # horizontal resolution of a photogrammetric surface
_BUMPS_M = (0.03, 0.25)  # its vertical noise


def coarse_mesh(scene: LitScene, rng: np.random.Generator) -> LitScene:
    """The scene's height field as photogrammetry gives it: rounded edges and bumps. Prisms stay as
    they are. The side of the height field, in cells, must be a multiple of `BLOCK`.
    """
    n, cell = scene.height.shape[0], scene.cell_m
    factor = float(np.exp(rng.uniform(*np.log(_MESH_M)))) / cell
    height = scene.height
    if factor > 1.0:
        side = max(int(n / min(factor, 6.0)), 64)
        small = cv2.resize(height, (side, side), interpolation=cv2.INTER_AREA)
        height = cv2.resize(small, (n, n), interpolation=cv2.INTER_LINEAR)
    bumps = noise(n, rng, max(int(n * cell / 8.0), 4), 2, 0.5)
    height = (height + np.float32(rng.uniform(*_BUMPS_M)) * bumps).astype(np.float32)
    raised = cv2.dilate(height, np.ones((3, 3), np.uint8))
    block_max = raised.reshape(n // BLOCK, BLOCK, n // BLOCK, BLOCK).max((1, 3))
    return replace(scene, height=height, block_max=block_max)


def plain_walls(prisms: list[Prism]) -> list[Prism]:
    """The buildings as seen from above only: walls without windows."""
    return [replace(p, window_m=0.0) for p in prisms]
