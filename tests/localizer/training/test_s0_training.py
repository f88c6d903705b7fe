"""The paper's network through the whole training: schedule, resumption, export, int8, float16."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")
onnx = pytest.importorskip("onnx")

from localizer.errors import ModelError  # noqa: E402
from localizer.features.extractor import OnnxExtractor  # noqa: E402
from localizer.training.config import TrainConfig, load_config  # noqa: E402
from localizer.training.data.pairs import SceneConfig  # noqa: E402
from localizer.training.data.shards import write_shard  # noqa: E402
from localizer.training.export.export import export  # noqa: E402
from localizer.training.loop.train import Trainer, alignment_ramp  # noqa: E402
from localizer.training.models.s0 import S0Config  # noqa: E402

CONFIGS = Path(__file__).parents[3] / "configs"
SCENES = SceneConfig(cells=256, width=128, height=96, references=3, queries_per_light=3)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    write_shard(folder, 2000, SCENES, None)
    return folder


@pytest.fixture(scope="module")
def config(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainConfig:
    run = load_config(CONFIGS / "train_s0_cpu.yaml")
    data = run.data.model_copy(update={"shards": shards, "first_seed": 2000, "scenes": 1,
                                       "initial_scenes": 1, "worlds": 0})  # fmt: skip
    optimizer = run.optimizer.model_copy(update={
        "batch": 2, "anchors": 64, "crop": (64, 48), "steps": 4, "decay_steps": 2,
        "warmup_steps": 1, "alignment_first_step": 1, "alignment_ramp_steps": 2,
        "mixed_precision": False,
    })  # fmt: skip
    return run.model_copy(update={"output": tmp_path_factory.mktemp("run"), "data": data,
                                  "model": S0Config(channels=8, branches=2),
                                  "optimizer": optimizer, "checkpoint_steps": 2})  # fmt: skip


@pytest.fixture(scope="module")
def trainer(config: TrainConfig) -> Trainer:
    trained = Trainer(config)
    trained.run()
    return trained


@pytest.fixture(scope="module")
def model(trainer: Trainer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "s0.onnx"
    export(trainer.checkpoint, path)
    return path


def test_confidence_is_learned_once_eq_3_has_come_in(config: TrainConfig, tmp_path: Path) -> None:
    run = Trainer(config.model_copy(update={"output": tmp_path}))
    heads = [head.weight.detach().clone() for head in run.model.uncertainties]
    o = run.config.optimizer
    assert [alignment_ramp(step, o) for step in range(5)] == [0.0, 0.0, 0.5, 1.0, 1.0]
    run.run(steps=1)  # the correspondence loss alone says nothing about confidence
    decay = 1 - o.learning_rate * o.weight_decay
    for head, first in zip(run.model.uncertainties, heads, strict=True):
        torch.testing.assert_close(head.weight, first * decay)
    run.run(steps=3)
    assert all(
        not torch.allclose(head.weight, first, atol=1e-4)
        for head, first in zip(run.model.uncertainties, heads, strict=True)
    )


def test_the_exported_model_runs_at_sizes_divisible_by_eight(model: Path) -> None:
    extractor = OnnxExtractor(model, threads=1)
    assert [level.stride for level in extractor.info.levels] == [4, 2, 1]
    pyramid = extractor.extract(np.zeros((40, 56, 3), np.uint8))
    assert [level.features.shape for level in pyramid.levels] == [
        (10, 14, 8), (20, 28, 8), (40, 56, 8),
    ]  # fmt: skip
    # The encoder goes down to stride 8 although the coarsest level is at 4.
    with pytest.raises(ModelError, match="divisible by 8"):
        extractor.extract(np.zeros((36, 56, 3), np.uint8))


def test_float16_is_close_and_says_so(trainer: Trainer, tmp_path: Path) -> None:
    path = tmp_path / "s0.onnx"
    parity = export(trainer.checkpoint, path, half=True)
    assert parity.cosine == pytest.approx(1.0, abs=5e-4)  # of lengths that are 1 but for rounding
    assert 1e-6 < parity.difference < 0.05
    kinds = {i.data_type for i in onnx.load(path).graph.initializer if len(i.dims) == 4}
    assert kinds == {onnx.TensorProto.FLOAT16}
    assert OnnxExtractor(path).info.name == "s0-float16"
