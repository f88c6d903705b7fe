"""Pairs that are rendered while training: determinism, resumption, configuration."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from localizer.training.config import LiveSection, TrainConfig, load_config  # noqa: E402
from localizer.training.data.batches import LiveStream  # noqa: E402
from localizer.training.loop.train import Trainer  # noqa: E402
from localizer.training.models.s0 import S0Config  # noqa: E402

SHIPPED = Path(__file__).parents[3] / "configs" / "train_s0.yaml"


def small_run(**changes: object) -> TrainConfig:
    """The shipped run, with small places, views and network."""
    run = load_config(SHIPPED)
    assert isinstance(run.data, LiveSection)
    data = run.data.model_copy(update={
        "image": (128, 96), "cells": 256, "first_seed": 3000, "scenes": 50, "active": 2,
        "steps_per_scene": 2, "flight_days": 1, "photos": None, "workers": 1,
    })  # fmt: skip
    optimizer = run.optimizer.model_copy(update={
        "batch": 2, "anchors": 64, "crop": (96, 64), "steps": 2, "decay_steps": 1, "threads": 1,
    })  # fmt: skip
    update = {"data": data, "optimizer": optimizer, "model": S0Config(channels=8)} | changes
    return run.model_copy(update=update)


@pytest.fixture(scope="module")
def stream():
    made = LiveStream(small_run())
    yield made
    made.close()


def test_a_step_sees_the_same_wherever_the_run_was_resumed(stream: LiveStream) -> None:
    stream.batch(0)
    stream.batch(1)
    third = stream.batch(2)  # one place of two has been replaced
    later = LiveStream(small_run())
    again = later.batch(2)
    later.close()
    for a, b in zip(vars(third).values(), vars(again).values(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert not torch.equal(third.images, stream.batch(3).images)


def test_places_differ_between_processes(stream: LiveStream) -> None:
    other = LiveStream(small_run(), rank=1, count=2)
    assert not torch.equal(other.batch(0).images, stream.batch(0).images)
    other.close()


def test_the_shipped_run_trains_a_small_s0(tmp_path: Path) -> None:
    trainer = Trainer(small_run(output=tmp_path))
    trainer.run()
    assert trainer.checkpoint.exists()
    assert trainer.step == 2


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
