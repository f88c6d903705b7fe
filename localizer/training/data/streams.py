"""Opens the source of a run's batches: shards on disk, or pairs rendered on demand."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace

from localizer.training.config import DataSection, LiveSection, TrainConfig
from localizer.training.data.batches import BatchStream, LoaderConfig, Schedule, ShardStream
from localizer.training.data.live import LivePlan, LiveStream
from localizer.training.data.pairs import SceneConfig
from localizer.training.data.seeds import FIRST_WORLD_SEED
from localizer.training.data.shards import PhotoSource, shard_path, world_shard_paths
from localizer.training.distributed import TrainingProcess


def open_stream(
    config: TrainConfig, workers: TrainingProcess, generating: Future[None] | None
) -> BatchStream:
    """The batches of one process of a run. generating: writes missing shards meanwhile."""
    data, o = config.data, config.optimizer
    loader = LoaderConfig(o.batch, o.anchors, o.crop, data.appearance)
    if isinstance(data, DataSection):
        return ShardStream(schedule(data), loader, config.seed, workers.rank, generating)
    plan = LivePlan(
        data.first_seed, data.scenes, data.active, data.steps_per_scene, data.flight_days
    )
    return LiveStream(
        plan, scene_config(data), photo_source(data), loader, config.seed, rank=workers.rank,
        count=workers.count, workers=data.workers,
    )  # fmt: skip


def schedule(data: DataSection) -> Schedule:
    """Which shards each step of a run draws from."""
    seeds = range(data.first_seed, data.first_seed + data.scenes)
    worlds = range(FIRST_WORLD_SEED, FIRST_WORLD_SEED + data.worlds)
    return Schedule(
        tuple(shard_path(data.shards, seed) for seed in seeds),
        data.initial_scenes,
        data.scenes_per_step,
        tuple(path for seed in worlds for path in world_shard_paths(data.shards, seed)),
        data.world_share,
        data.world_first_step,
    )


def scene_config(data: DataSection | LiveSection) -> SceneConfig:
    """Scene configuration of a run's data section."""
    scenes = SceneConfig(photo_share=data.photo_share, light_variety=data.light_variety)
    width, height = data.image
    scenes = replace(scenes, width=width, height=height)
    return scenes if isinstance(data, DataSection) else replace(scenes, cells=data.cells)


def photo_source(data: DataSection | LiveSection) -> PhotoSource | None:
    """The real textures of a run; None if it uses none."""
    return None if data.photos is None else PhotoSource(data.photos, data.photo_groups)
