"""The lower half of the paper's Table 4: what the training data contributes, in equal runs."""

from __future__ import annotations

from localizer.training.config import TrainConfig


def ablations(config: TrainConfig, steps: int) -> dict[str, TrainConfig]:
    """Three runs of `steps` steps that differ in their data alone, by name.

    "plain": the query keeps the map's light and season and gets no weather or sensor. "generated":
    no real textures. "full": as configured. Each has its own output and, because scenes differ,
    its own shards beside the configured ones; mesh worlds, which always change their light, are
    left out of all three.
    """
    changes: dict[str, dict[str, object]] = {
        "plain": {"light_variety": False, "appearance": False},
        "generated": {"photos": None, "photo_groups": ()},
        "full": {},
    }
    optimizer = config.optimizer.model_copy(update={"steps": steps, "decay_steps": steps // 2})
    runs = {}
    for name, change in changes.items():
        shards = config.data.shards.with_name(f"{config.data.shards.name}-{name}")
        data = config.data.model_copy(update={**change, "shards": shards, "worlds": 0})
        runs[name] = config.model_copy(
            update={
                "output": config.output.with_name(f"{config.output.name}-{name}"),
                "data": data,
                "optimizer": optimizer,
            }
        )
    return runs
