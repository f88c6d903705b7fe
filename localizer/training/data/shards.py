"""Pairs on disk: one shard (``SEED.npz``) per generated place, written once and streamed.

A shard's content depends on its seed and the scene configuration alone.
"""

from __future__ import annotations

import os
import zipfile
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path

import numpy as np

from localizer.errors import LocalizerError, SequenceError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.training.data.pairs import Pair, SceneConfig, scene_pairs
from localizer.training.places.land import PhotoLibrary

WORLD_SHARDS = 8  # per mesh world
WORLD_SHARD_PAIRS = 10


def write_shards(
    out: Path, seeds: range, scenes: SceneConfig, photos: PhotoLibrary | None, workers: int
) -> Iterator[Path]:
    """Generate the shards of `seeds` not on disk yet, while iterated; yields them in that order."""
    out.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not shard_path(out, seed).exists()]
    with ProcessPoolExecutor(workers, initializer=os.nice, initargs=(5,)) as pool:
        tasks: deque[Future[Path]] = deque()
        for seed in missing:
            tasks.append(pool.submit(write_shard, out, seed, scenes, photos))
            # Few at a time: a process that is to end still makes all that was submitted.
            if len(tasks) > 2 * workers:
                yield tasks.popleft().result()
        for task in tasks:
            yield task.result()


def write_world_shards(out: Path, seeds: range, scenes: SceneConfig) -> Iterator[Path]:
    """Generate the shards of mesh worlds, one world at a time while iterated, and yield their
    paths. A world whose shards are all on disk is skipped; otherwise all of its shards are written
    again.
    """
    # The map's importers (GDAL, pyproj, trimesh) are not needed on a machine that only trains.
    from localizer.training.data.worlds import world_pairs

    for seed in seeds:
        paths = world_shard_paths(out, seed)
        if all(path.exists() for path in paths):
            continue
        pairs = list(world_pairs(seed, scenes, count=len(paths) * WORLD_SHARD_PAIRS))
        out.mkdir(parents=True, exist_ok=True)
        for k, path in enumerate(paths):
            yield store(path, pairs[k * WORLD_SHARD_PAIRS : (k + 1) * WORLD_SHARD_PAIRS], scenes)


def world_shard_paths(out: Path, seed: int) -> list[Path]:
    """Paths of the shards of one world."""
    return [out / f"world-{seed:06d}-{k}.npz" for k in range(WORLD_SHARDS)]


def shard_path(folder: Path, seed: int) -> Path:
    """Path of the shard of a seed."""
    return folder / f"{seed:08d}.npz"


def write_shard(out: Path, seed: int, scenes: SceneConfig, photos: PhotoLibrary | None) -> Path:
    """Generate and store one place's pairs."""
    return store(shard_path(out, seed), list(scene_pairs(seed, scenes, photos)), scenes)


def store(path: Path, pairs: list[Pair], scenes: SceneConfig) -> Path:
    """Write a shard and return its path. The file appears whole or not at all."""
    partial = path.with_suffix(".partial.npz")
    try:
        np.savez(
            partial,
            reference=_stack([p.reference for p in pairs], scenes, np.uint8),
            query=_stack([p.query for p in pairs], scenes, np.uint8),
            reference_depth=_stack([p.reference_depth for p in pairs], scenes, np.float16),
            query_depth=_stack([p.query_depth for p in pairs], scenes, np.float16),
            world_from_reference=np.array([p.world_from_reference.matrix for p in pairs]),
            world_from_query=np.array([p.world_from_query.matrix for p in pairs]),
            focal_px=np.array([p.camera.fx for p in pairs]),
            condition=np.array([p.condition for p in pairs]),
            outdated=np.array([p.outdated for p in pairs]),
            source=np.array([p.source for p in pairs]),
            season=np.array([p.season for p in pairs]),
        )
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def read_shard(path: Path) -> list[Pair]:
    """The pairs of one shard. `SequenceError` if the file cannot be read or holds no pairs."""
    try:
        # Opened here: NumPy leaves a damaged archive open.
        with path.open("rb") as file, np.load(file) as data:
            z = {key: data[key] for key in data.files}
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        why = str(error).split("\n")[0]
        raise SequenceError(f"{path}: cannot be read as a shard: {why}; remove it") from error
    try:
        return _pairs(z)
    # Of another program, or of another version of this one.
    except (KeyError, IndexError, ValueError, TypeError, LocalizerError) as error:
        why = str(error).split("\n")[0]
        raise SequenceError(f"{path}: holds no training pairs: {why}; remove it") from error


def _pairs(z: dict[str, np.ndarray]) -> list[Pair]:
    count, height, width = z["reference"].shape[:3]
    return [
        Pair(
            z["reference"][k],
            z["reference_depth"][k].astype(np.float32),
            z["query"][k],
            z["query_depth"][k].astype(np.float32),
            Pose.from_matrix(z["world_from_reference"][k]),
            Pose.from_matrix(z["world_from_query"][k]),
            Camera(
                width, height, z["focal_px"][k], z["focal_px"][k], width / 2, height / 2
            ),
            str(z["condition"][k]),
            bool(z["outdated"][k]),
            str(z["source"][k]),
            bool(z["season"][k]) if "season" in z else False,
        )
        for k in range(count)
    ]  # fmt: skip


def _stack(arrays: list[np.ndarray], scenes: SceneConfig, dtype: type) -> np.ndarray:
    if not arrays:
        shape = (0, scenes.height, scenes.width)
        return np.zeros((*shape, 3) if dtype is np.uint8 else shape, dtype)
    return np.stack(arrays).astype(dtype)
