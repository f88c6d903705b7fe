"""Generated test pairs for the feature benchmark: unseen places.

What differs between map and query is drawn by the training's own generator, with other seeds and
with real textures that no training run has seen; model-card.md says what each difference
stands for.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localizer.geometry.pose import Pose
from localizer.synth.appearance.model import CONDITIONS, weathered
from localizer.training.data.pairs import COMBINED, OUTDATED, SEASON, Pair, SceneConfig
from localizer.training.data.shards import read_shard, shard_path, write_shards
from localizer.training.places.land import PhotoLibrary
from localizer.types import Image, RenderedView

METRES, DEGREES = 5.0, 5.0  # distance of the reference view from the query's true pose
UNSEEN_GROUPS = ("boruszyn", "garfield_autumn", "neon_sjer_pairs")
MADE_CONDITIONS = (*CONDITIONS, SEASON, OUTDATED, COMBINED)  # of each place a pair of each
_FIRST_SEED = {"test": 5_000_000, "validation": 4_000_000}
SIZE = (320, 240)


@dataclass(frozen=True)
class TestPair:
    """A rendered reference view, the query image of the same size, and the query's true pose.

    place: pairs of one place are not independent.
    """

    view: RenderedView
    query: Image
    truth: Pose
    condition: str
    place: int = 0


@dataclass(frozen=True)
class MadePlaces:
    """Which generated pairs: split (test or validation), seed (0, 1, 2, ... other places), and
    the folder of the real textures, if any.
    """

    split: str
    seed: int
    textures: Path | None

    @property
    def name(self) -> str:
        """Folder of these pairs in the cache."""
        return f"made-{self.split}-{self.seed}" + ("" if self.textures else "-untextured")

    @property
    def scenes(self) -> SceneConfig:
        """Size and variety: each place is seen once under every condition."""
        return SceneConfig(
            cells=768,
            width=SIZE[0],
            height=SIZE[1],
            photo_share=0.4,
            references=len(MADE_CONDITIONS),
            queries_per_light=1,
            cell_m=(0.25, 0.55),
            conditions=MADE_CONDITIONS,
            motion=(METRES, DEGREES),
        )


def made_pairs(count: int, which: MadePlaces, cache: Path, workers: int = 2) -> list[TestPair]:
    """Pairs of unseen generated places, conditions in equal shares; written to `cache` once."""
    first = _FIRST_SEED[which.split] + 10_000 * which.seed
    places = range(first, first + round(1.1 * count / len(MADE_CONDITIONS)) + 1)
    folder = cache / which.name
    photos = None
    if which.textures is not None:
        photos = PhotoLibrary(which.textures, UNSEEN_GROUPS, held_out=True)
    for _ in write_shards(folder, places, which.scenes, photos, workers):
        pass
    pairs: list[TestPair] = []
    for seed in places:
        rng = np.random.default_rng((seed, 1))
        pairs += [_degraded(p, rng, seed) for p in read_shard(shard_path(folder, seed))]
    return pairs[:count]


def _degraded(pair: Pair, rng: np.random.Generator, place: int) -> TestPair:
    query = weathered(pair.query, pair.query_depth, pair.condition, rng)
    view = RenderedView(
        pair.reference, pair.reference_depth, pair.world_from_reference, pair.camera
    )
    kinds = {(True, False): OUTDATED, (False, True): SEASON, (True, True): COMBINED}
    condition = kinds.get((pair.outdated, pair.season), pair.condition)
    return TestPair(view, query, pair.world_from_query, condition, place)
