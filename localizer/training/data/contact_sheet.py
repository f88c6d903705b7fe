"""A contact sheet of training pairs with the depth-warp check of the paper's Fig. 14."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from localizer.pictures import write_rgb
from localizer.synth.appearance.model import weathered
from localizer.training.data.pairs import Pair, warp_check
from localizer.types import Image

_CHECKER_PX = 24


def contact_sheet(pairs: Sequence[Pair], path: Path) -> Path:
    """Write one row a pair: reference, clean query, degraded query, warped checkerboard, depth."""
    rows = [_row(pair, np.random.default_rng(k)) for k, pair in enumerate(pairs)]
    write_rgb(path, np.vstack(rows))
    return path


def _row(pair: Pair, rng: np.random.Generator) -> Image:
    degraded = weathered(pair.query, pair.query_depth, pair.condition, rng)
    warped, mask = warp_check(pair)
    height, width = mask.shape
    tiles = np.add.outer(np.arange(height) // _CHECKER_PX, np.arange(width) // _CHECKER_PX) % 2
    checker = pair.reference.copy()
    shown = mask & (tiles == 1)
    checker[shown] = warped[shown].astype(np.uint8)
    depth = pair.reference_depth
    gray = (255 * (depth - depth.min()) / max(float(np.ptp(depth)), 1e-3)).astype(np.uint8)
    return np.hstack(
        [pair.reference, pair.query, degraded, checker, np.repeat(gray[..., None], 3, 2)]
    )
