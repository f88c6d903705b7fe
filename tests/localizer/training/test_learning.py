import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

import torch  # noqa: E402

from localizer.errors import ModelError  # noqa: E402
from localizer.features.extractor import OnnxExtractor  # noqa: E402
from localizer.training.config import TrainConfig, load_config  # noqa: E402
from localizer.training.data.batches import collate, crop_pair  # noqa: E402
from localizer.training.data.pairs import SceneConfig, scene_pairs  # noqa: E402
from localizer.training.data.shards import write_shard  # noqa: E402
from localizer.training.export.export import export  # noqa: E402
from localizer.training.loop.train import Trainer, perturbed_poses  # noqa: E402
from localizer.training.losses import Batch, alignment_loss, project, sample  # noqa: E402
from localizer.training.models.tiny import ModelConfig  # noqa: E402

SHIPPED = Path(__file__).parents[3] / "configs" / "train_tiny.yaml"
SCENES = SceneConfig(cells=256, width=128, height=96, references=3, queries_per_light=3)
LOADER = load_config(SHIPPED).optimizer.model_copy(update={"anchors": 64, "crop": (96, 64)})


SECOND = """
import sys
from pathlib import Path
import torch
from localizer.training.config import load_config
from localizer.training.loop.train import Trainer
trainer = Trainer(load_config(Path(sys.argv[1])))
trainer.run(steps=1)
torch.save([p.data for p in trainer.model.parameters()], sys.argv[2])
"""


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    for seed in (2000, 2001):
        write_shard(folder, seed, SCENES, None)
    return folder


@pytest.fixture
def config(shards: Path, tmp_path: Path) -> TrainConfig:
    run = load_config(SHIPPED)
    data = run.data.model_copy(update={"shards": shards, "first_seed": 2000, "scenes": 2,
                                       "initial_scenes": 2, "scenes_per_step": 0.0,
                                       "worlds": 0})  # fmt: skip
    optimizer = run.optimizer.model_copy(update={"batch": 2, "anchors": 64, "crop": (96, 64),
                                                 "steps": 6, "decay_steps": 3,
                                                 "threads": 1})  # fmt: skip
    model = ModelConfig(channels=16, widths=(8, 8, 16), decoder=(8, 8), dilations=(1, 2))
    return run.model_copy(update={"output": tmp_path, "data": data, "optimizer": optimizer,
                                  "model": model, "checkpoint_steps": 3})  # fmt: skip


@pytest.fixture(scope="module")
def batch() -> Batch:
    rng = np.random.default_rng(0)
    samples = []
    for pair in scene_pairs(2000, SCENES, None):
        made = crop_pair(pair, LOADER, rng)
        if made is not None:
            samples.append(made)
    return collate(samples)


def test_anchors_project_where_the_query_shows_them(batch: Batch) -> None:
    pixels, _ = project(batch.query_from_reference, batch.points, batch.K_query)
    error = (pixels - batch.query_pixels).norm(dim=-1)[batch.visible > 0]
    assert float(error.max()) < 0.02
    assert float(batch.visible.mean()) > 0.25


def ideal_features(batch: Batch, stride: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Anchor features and a query map that agree at the true pose: smooth waves over the image."""
    h, w = batch.images.shape[2] // stride, batch.images.shape[3] // stride
    v, u = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    waves = torch.stack([torch.sin(u / 3), torch.cos(u / 3), torch.sin(v / 3), torch.cos(v / 3)])
    query = (waves / 2**0.5).expand(len(batch.points), -1, -1, -1)
    return sample(query, batch.query_pixels / stride), query


def test_lm_walks_to_the_true_pose_on_ideal_features(batch: Batch) -> None:
    batch = replace(batch, visible=torch.ones_like(batch.visible))
    anchors, query = ideal_features(batch, 2)
    start = perturbed_poses(batch, 3.0, torch.Generator().manual_seed(0))
    trust = torch.ones(anchors.shape[:2])
    everywhere = torch.ones(query.shape[0], *query.shape[2:])
    _, begin = alignment_loss(batch, (anchors, trust), (query, everywhere), 2, start, 1)
    loss, error = alignment_loss(batch, (anchors, trust), (query, everywhere), 2, start, 6)
    assert float(error.mean()) < 0.3 * float(begin.mean())
    assert torch.isfinite(loss)


def test_a_run_resumes_exactly(config: TrainConfig, tmp_path: Path) -> None:
    whole = Trainer(config.model_copy(update={"output": tmp_path / "whole"}))
    whole.run()
    parts = config.model_copy(update={"output": tmp_path / "parts"})
    Trainer(parts).run(steps=3)
    second = Trainer(parts)
    assert second.step == 3
    second.run()
    for a, b in zip(
        whole.average.state_dict().values(), second.average.state_dict().values(), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert (tmp_path / "whole" / "tiny.csv").stat().st_size


def test_two_processes_take_the_same_step(config, tmp_path, monkeypatch) -> None:
    # This process and another as torchrun starts them, with a store that its agent holds, whose
    # port is thus taken from the start; importing torch takes most of this test's time.
    alone = Trainer(config.model_copy(update={"output": tmp_path / "alone"}))
    alone.run(steps=1)
    run = tmp_path / "run.yaml"
    run.write_text(yaml.safe_dump(config.model_dump(mode="json")))
    store = torch.distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(store.port),
              "TORCHELASTIC_USE_AGENT_STORE": "True"}  # fmt: skip
    for name, value in (shared | {"RANK": "0"}).items():
        monkeypatch.setenv(name, value)
    command = [sys.executable, "-c", SECOND, str(run), str(tmp_path / "second.pt")]
    with subprocess.Popen(command, env=os.environ | {"RANK": "1"}) as second:
        try:
            first = Trainer(config)
            first.run(steps=1)
            assert second.wait(timeout=600) == 0
        finally:
            second.kill()
            torch.distributed.destroy_process_group()
    for a, b in zip(first.model.parameters(), torch.load(tmp_path / "second.pt"), strict=True):
        torch.testing.assert_close(a.data, b, rtol=0, atol=0)
    # The second process's batches count: one process alone ends elsewhere.
    weights = zip(first.model.parameters(), alone.model.parameters(), strict=True)
    assert any(not torch.equal(a, b) for a, b in weights)
    rows = (config.output / "tiny.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["step", "1"]


def test_training_lowers_the_loss(config: TrainConfig) -> None:
    optimizer = config.optimizer.model_copy(
        update={"steps": 60, "decay_steps": 30, "warmup_steps": 5}
    )
    trainer = Trainer(config.model_copy(update={"optimizer": optimizer}))
    trainer.run()
    rows = (config.output / "tiny.csv").read_text().splitlines()
    name = rows[0].split(",").index("contrast_0")
    first, last = float(rows[1].split(",")[name]), float(rows[-1].split(",")[name])
    assert last < first - 0.2


def test_export_is_checked_against_torch(config: TrainConfig, tmp_path: Path) -> None:
    trainer = Trainer(config)
    trainer.run(steps=1)
    model = tmp_path / "model" / "tiny.onnx"
    assert export(trainer.checkpoint, model).difference < 2e-4
    with pytest.raises(ModelError, match="float16 is for s0"):
        export(trainer.checkpoint, model, half=True)
    extractor = OnnxExtractor(model, threads=1)
    assert [level.stride for level in extractor.info.levels] == [8, 4, 2]
    text = model.with_suffix(".json").read_text()
    assert str(config.data.shards) not in text
