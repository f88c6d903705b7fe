"""Pairs that are rendered while training: geometry, determinism, resumption, configuration."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from localizer.errors import ModelError  # noqa: E402
from localizer.training.config import LiveSection, TrainConfig, load_config  # noqa: E402
from localizer.training.data.batches import LoaderConfig  # noqa: E402
from localizer.training.data.live import LivePlan, LiveStream  # noqa: E402
from localizer.training.data.pairs import SceneConfig  # noqa: E402
from localizer.training.loop.train import Trainer  # noqa: E402
from localizer.training.losses import project  # noqa: E402
from localizer.training.models.s0 import S0Config  # noqa: E402

SHIPPED = Path(__file__).parents[3] / "configs" / "train_s0.yaml"
SCENES = SceneConfig(cells=256, width=128, height=96)
LOADER = LoaderConfig(batch=3, anchors=64, crop=(96, 64), appearance=True)
PLAN = LivePlan(first_seed=3000, places=50, active=2, steps_per_place=2, flight_days=2)


def opened(loader: LoaderConfig = LOADER, **changes: int) -> LiveStream:
    return LiveStream(PLAN, SCENES, None, loader, 5, **changes)


@pytest.fixture(scope="module")
def stream():
    made = opened()
    yield made
    made.close()


def test_anchors_project_where_the_query_shows_them(stream: LiveStream) -> None:
    batch = stream.batch(0)
    assert batch.images.shape == (6, 3, 64, 96)
    pixels, _ = project(batch.query_from_reference, batch.points, batch.K_query)
    error = (pixels - batch.query_pixels).norm(dim=-1)[batch.visible > 0]
    assert float(error.max()) < 0.02
    assert float(batch.visible.mean()) > 0.25


def test_a_step_sees_the_same_wherever_the_run_was_resumed(stream: LiveStream) -> None:
    stream.batch(0)
    stream.batch(1)
    third = stream.batch(2)  # one place of two has been replaced
    later = opened()
    again = later.batch(2)
    later.close()
    for a, b in zip(vars(third).values(), vars(again).values(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert not torch.equal(third.images, stream.batch(3).images)


def test_places_come_one_at_a_time_and_differ_between_processes() -> None:
    windows = [list(PLAN.window(step)) for step in range(5)]
    assert windows == [[0, 1], [0, 1], [1, 2], [1, 2], [2, 3]]
    seeds = {rank: [PLAN.seed(k, rank, 2) for k in range(4)] for rank in (0, 1)}
    assert seeds == {0: [3000, 3002, 3004, 3006], 1: [3001, 3003, 3005, 3007]}


def test_the_shipped_run_trains_a_small_s0(tmp_path: Path) -> None:
    run = load_config(SHIPPED)
    assert isinstance(run.data, LiveSection)
    data = run.data.model_copy(update={
        "image": (128, 96), "cells": 256, "active": 2, "steps_per_scene": 2, "flight_days": 1,
        "photos": None, "workers": 1,
    })  # fmt: skip
    optimizer = run.optimizer.model_copy(update={
        "batch": 2, "anchors": 64, "crop": (96, 64), "steps": 2, "decay_steps": 1, "threads": 1,
    })  # fmt: skip
    small: TrainConfig = run.model_copy(update={
        "output": tmp_path, "data": data, "optimizer": optimizer, "model": S0Config(channels=8),
    })  # fmt: skip
    trainer = Trainer(small)
    trainer.run()
    assert trainer.checkpoint.exists()
    assert trainer.step == 2


@pytest.mark.parametrize(
    ("line", "wrong", "why"),
    [
        ("crop: [512, 512]", "crop: [512, 516]", "divisible by 8"),
        ("crop: [512, 512]", "crop: [768, 512]", "exceeds the image"),
        ("active: 16 ", "active: 9000 ", "fewer than active"),
        ("cells: 1536", "cells: 1500", "cells"),
        ("live: true", "live: true\n  shards: here", "shards"),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, line: str, wrong: str, why: str) -> None:
    text = SHIPPED.read_text()
    assert line in text
    path = tmp_path / "run.yaml"
    path.write_text(text.replace(line, wrong, 1))
    with pytest.raises(ModelError, match=why):
        load_config(path)


_OPENGL_FIRST = """
import localizer.training.loop.train
from localizer.errors import RenderError
from localizer.render.base import StaticTiles
from localizer.render.select import make_renderer
try:
    make_renderer("moderngl", StaticTiles([]))
except RenderError as error:
    raise SystemExit(str(error))
import torch
torch.optim.AdamW([torch.zeros(1, requires_grad=True)])
print("made")
"""


def test_an_optimizer_can_be_made_after_a_software_opengl_was_opened() -> None:
    """Mesa's LLVM, then Triton's, ended a training with a segmentation fault."""
    result = subprocess.run(
        [sys.executable, "-c", _OPENGL_FIRST], capture_output=True, text=True, check=False
    )
    if result.returncode == 1 and "Traceback" not in result.stderr:
        pytest.skip(result.stderr.strip())
    assert result.stdout == "made\n", (result.returncode, result.stderr)
