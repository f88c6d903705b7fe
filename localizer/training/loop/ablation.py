"""The lower half of the paper's Table 4: what the training data contributes, in equal runs."""

from __future__ import annotations

from localizer.training.config import DataSection, TrainConfig


def ablations(config: TrainConfig, steps: int, scenes: int) -> dict[str, TrainConfig]:
    """Three runs of `steps` steps on `scenes` places that differ in their data alone, by name.

    "full": as configured; its places are the configured run's first ones, so their shards are
    shared. "plain": the query keeps the map's light and season and gets no weather or sensor.
    "generated": no real textures. The last two have shards of their own beside the configured ones.
    Each has its own output. Mesh worlds, which always change their light, are left out of all.
    """
    changes: dict[str, dict[str, object]] = {
        "full": {},
        "plain": {"light_variety": False, "appearance": False},
        "generated": {"photos": None, "photo_groups": ()},
    }
    optimizer = config.optimizer.model_copy(update={"steps": steps, "decay_steps": steps // 2})
    equal: dict[str, object] = {"scenes": scenes}
    if isinstance(config.data, DataSection):
        equal |= {"worlds": 0, "initial_scenes": scenes}
    runs = {}
    for name, change in changes.items():
        if change and isinstance(config.data, DataSection):
            folder = config.data.shards
            change["shards"] = folder.with_name(f"{folder.name}-{name}")
        data = config.data.model_copy(update={**equal, **change})
        runs[name] = config.model_copy(
            update={
                "output": config.output.with_name(f"{config.output.name}-{name}"),
                "data": data,
                "optimizer": optimizer,
            }
        )
    return runs
