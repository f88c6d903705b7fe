"""Generated test pairs for the feature benchmark: unseen places and a mesh world.

What differs between map and query is drawn by the training's own generator, with other seeds and
with real textures that no training run has seen; model-card.md says what each difference
stands for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from localizer.geometry.pose import Pose
from localizer.synth.appearance.model import CONDITIONS, weathered
from localizer.training.data.pairs import COMBINED, OUTDATED, SEASON, Pair, SceneConfig
from localizer.training.data.shards import PhotoSource, read_shard, shard_path, write_shards
from localizer.training.data.worlds import world_pairs
from localizer.types import Image, RenderedView

METRES, DEGREES = 5.0, 5.0  # distance of the reference view from the query's true pose
UNSEEN_GROUPS = ("boruszyn", "garfield_autumn", "neon_sjer_pairs")
MADE_CONDITIONS = (*CONDITIONS, SEASON, OUTDATED, COMBINED)
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
    the folder of the real textures, if any; size: of the pictures. Wider ones look from further
    away, so that a pixel is as much ground.
    """

    split: str
    seed: int
    textures: Path | None
    size: tuple[int, int] = SIZE

    @property
    def conditions(self) -> tuple[str, ...]:
        """Of which each place has one pair."""
        return MADE_CONDITIONS

    @property
    def name(self) -> str:
        """Folder of these pairs in the cache."""
        wide = "" if self.size == SIZE else f"-{self.size[0]}"
        return f"made-{self.split}-{self.seed}{wide}" + ("" if self.textures else "-untextured")

    @property
    def scenes(self) -> SceneConfig:
        """Size and variety: each place is seen once under every condition."""
        return SceneConfig(
            cells=768,
            width=self.size[0],
            height=self.size[1],
            photo_share=0.4,
            references=len(self.conditions),
            queries_per_light=1,
            cell_m=(0.25, 0.55),
            conditions=self.conditions,
            motion=(METRES, DEGREES),
        )


def made_pairs(count: int, which: MadePlaces, cache: Path, workers: int = 2) -> list[TestPair]:
    """Pairs of unseen generated places, conditions in equal shares; written to `cache` once."""
    first = _FIRST_SEED[which.split] + 10_000 * which.seed
    places = range(first, first + round(1.1 * count / len(which.conditions)) + 1)
    folder = cache / which.name
    photos = None
    if which.textures is not None:
        photos = PhotoSource(which.textures, UNSEEN_GROUPS, held_out=True)
    for _ in write_shards(folder, places, which.scenes, photos, workers):
        pass
    pairs: list[TestPair] = []
    for seed in places:
        rng = np.random.default_rng((seed, 1))
        pairs += [_degraded(p, rng, seed) for p in read_shard(shard_path(folder, seed))]
    return pairs[:count]


def narrowed(pair: TestPair, width: int) -> TestPair:
    """The same pair in pictures of `width` pixels."""
    camera = pair.view.camera
    if width == camera.width:
        return pair
    size = (width, round(camera.height * width / camera.width))
    rgb, query = (cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (
        pair.view.rgb, pair.query))  # fmt: skip
    depth = cv2.resize(pair.view.depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
    view = RenderedView(rgb, depth, pair.view.world_from_camera, camera.resized(*size))
    return replace(pair, view=view, query=query)


def mesh_pairs(count: int, seed: int, size: tuple[int, int] = SIZE) -> list[TestPair]:
    """Pairs of a generated mesh world that no training run has seen."""
    rng = np.random.default_rng((seed, 2))
    scenes = MadePlaces("test", seed, None, size).scenes
    made = world_pairs(900_000 + seed, scenes, count=count)
    return [_degraded(pair, rng, k) for k, pair in enumerate(made)]


def _degraded(pair: Pair, rng: np.random.Generator, place: int) -> TestPair:
    query = weathered(pair.query, pair.query_depth, pair.condition, rng)
    view = RenderedView(
        pair.reference, pair.reference_depth, pair.world_from_reference, pair.camera
    )
    kinds = {(True, False): OUTDATED, (False, True): SEASON, (True, True): COMBINED}
    condition = kinds.get((pair.outdated, pair.season), pair.condition)
    return TestPair(view, query, pair.world_from_query, condition, place)
