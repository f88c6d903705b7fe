"""Real textures for training places: orthophotos below a folder, by group."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.errors import SequenceError
from localizer.pictures import read_rgb
from localizer.plain_files import without_hidden

_SEASONS = "neon_sjer_pairs"  # group whose plots were photographed at two dates


class PhotoLibrary:
    """Real textures below a folder, by group.

    Groups are kept apart for training and test by naming them. Of the cross-season plots, which are
    one group, every fourth is for tests: `held_out` takes those, otherwise the others are taken.
    """

    def __init__(self, root: Path, groups: tuple[str, ...], *, held_out: bool = False) -> None:
        self._files = {g: without_hidden((root / g).rglob("*.jpg")) for g in groups}
        if _SEASONS in self._files:
            plots = sorted({f.parent for f in self._files[_SEASONS]})
            mine = {p for k, p in enumerate(plots) if (k % 4 == 3) == held_out}
            self._files[_SEASONS] = [f for f in self._files[_SEASONS] if f.parent in mine]
        empty = [g for g, files in self._files.items() if not files]
        if empty:
            raise SequenceError(f"{root}: no *.jpg below {', '.join(empty)}")
        self.groups = groups

    def sample(self, rng: np.random.Generator, n: int) -> list[NDArray[np.uint8]]:
        """One place's texture layers, (n, n, 3) uint8 RGB each; several if its dates differ."""
        group = str(rng.choice(self.groups))
        files = self._files[group]
        if group == _SEASONS:
            return self._seasons(rng, n, files)
        if group == "neon_forest":
            chosen = rng.choice(len(files), 9, replace=True)
            return [_grid([read_rgb(files[i]) for i in chosen], n, 3)]
        image = read_rgb(files[int(rng.integers(len(files)))])
        short = min(image.shape[:2])
        side = int(rng.uniform(0.55, 1.0) * short)
        y = int(rng.integers(0, image.shape[0] - side + 1))
        x = int(rng.integers(0, image.shape[1] - side + 1))
        crop = image[y : y + side, x : x + side]
        resized = cv2.resize(crop, (n, n), interpolation=cv2.INTER_AREA if side > n else 1)
        turned = np.rot90(resized, int(rng.integers(4)))
        return [np.ascontiguousarray(turned[:, :: int(rng.choice((-1, 1)))])]

    def _seasons(
        self, rng: np.random.Generator, n: int, files: list[Path]
    ) -> list[NDArray[np.uint8]]:
        plots = sorted({f.parent for f in files})
        chosen = [plots[i] for i in rng.choice(len(plots), 9, replace=len(plots) < 9)]
        dates = [without_hidden(plot.glob("*.jpg")) for plot in chosen]
        layers = [_grid([read_rgb(d[k]) for d in dates], n, 3) for k in (0, -1)]
        return layers[:: int(rng.choice((-1, 1)))]


def _grid(images: list[NDArray[np.uint8]], n: int, per_side: int) -> NDArray[np.uint8]:
    """Square images tiled per_side x per_side and resized to (n, n, 3)."""
    side = n // per_side + 1
    small = [cv2.resize(i, (side, side), interpolation=cv2.INTER_AREA) for i in images]
    rows = [np.hstack(small[k : k + per_side]) for k in range(0, per_side**2, per_side)]
    return np.ascontiguousarray(np.vstack(rows)[:n, :n])
