"""Opens the source of a run's batches: shards on disk, or pairs rendered on demand."""

from __future__ import annotations

from concurrent.futures import Future

from localizer.training.config import DataSection, TrainConfig
from localizer.training.data.batches import BatchStream, Schedule, ShardStream
from localizer.training.data.live import LiveStream
from localizer.training.data.pairs import FIRST_WORLD_SEED
from localizer.training.data.shards import shard_path, world_shard_paths


def open_stream(
    config: TrainConfig, rank: int, count: int, generating: Future[None] | None
) -> BatchStream:
    """The batches of the process `rank` of a run's `count`. generating: writes missing shards
    meanwhile.
    """
    data = config.data
    if isinstance(data, DataSection):
        shards = schedule(data)
        return ShardStream(shards, config.optimizer, config.seed, rank, generating)
    return LiveStream(config, rank, count)


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
