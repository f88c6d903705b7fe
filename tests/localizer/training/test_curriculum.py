"""Sizes and hard pairs: what a step draws, and that a run with them goes on exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from localizer.errors import ModelError  # noqa: E402
from localizer.geometry.camera import Camera  # noqa: E402
from localizer.geometry.pose import Pose  # noqa: E402
from localizer.training.config import TrainConfig, load_config  # noqa: E402
from localizer.training.data.batches import LoaderConfig, collate, crop_pair  # noqa: E402
from localizer.training.data.hard import HardPairs, HardShare  # noqa: E402
from localizer.training.data.pairs import Pair, SceneConfig  # noqa: E402
from localizer.training.data.shards import store  # noqa: E402
from localizer.training.data.sizes import Size, draw_size, resized  # noqa: E402
from localizer.training.loop.train import Trainer  # noqa: E402
from localizer.training.losses import project  # noqa: E402
from localizer.training.models.tiny import ModelConfig  # noqa: E402

SHIPPED = Path(__file__).parents[3] / "configs" / "train_tiny_wide.yaml"


def level_pair(seed: int) -> Pair:
    """Noise 100 m below two level cameras 2 m apart."""
    rng = np.random.default_rng(seed)
    down = np.diag([1.0, -1.0, -1.0])
    depth = np.full((96, 128), 100.0, np.float32)
    images = rng.integers(0, 256, (2, 96, 128, 3), dtype=np.uint8)
    poses = [Pose(down, np.array([x, 0.0, 100.0])) for x in (0.0, 2.0)]
    camera = Camera(128, 96, 120.0, 120.0, 64.0, 48.0)
    return Pair(images[0], depth, images[1], depth, *poses, camera, "day", False, "generated")


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    for seed in (2000, 2001):
        pairs = [level_pair(seed), level_pair(seed + 10)]
        store(tmp_path / f"{seed:08d}.npz", pairs, SceneConfig(width=128, height=96))
    run = load_config(SHIPPED)
    hard = run.data.hard.model_copy(update={"every_steps": 2, "ranks": (0.0, 0.5)})
    data = run.data.model_copy(update={"shards": tmp_path, "image": (128, 96), "hard": hard,
                                       "first_seed": 2000, "scenes": 2,
                                       "initial_scenes": 2})  # fmt: skip
    narrow, wide = run.optimizer.sizes[0], run.optimizer.sizes[-1]
    sizes = (
        narrow.model_copy(update={"width": 64, "crop": (64, 48), "batch": 2}),
        wide.model_copy(update={"width": 128, "crop": (96, 64), "batch": 1, "first_step": 2}),
    )
    optimizer = run.optimizer.model_copy(update={"sizes": sizes, "anchors": 32, "steps": 8,
                                                 "decay_steps": 3})  # fmt: skip
    model = ModelConfig(channels=16, widths=(8, 8, 16), decoder=(8, 8), dilations=(1, 2))
    return run.model_copy(update={"data": data, "optimizer": optimizer, "model": model,
                                  "warm_start": None, "checkpoint_steps": 100,
                                  "kept_steps": 4})  # fmt: skip


def test_a_run_with_sizes_and_hard_pairs_resumes_exactly(config, tmp_path):
    whole = Trainer(config.model_copy(update={"output": tmp_path / "whole"}))
    whole.run()
    parts = config.model_copy(update={"output": tmp_path / "parts"})
    for steps in (4, 1, 3):  # 4 is where a list is made anew
        last = Trainer(parts)
        last.run(steps=steps)
    assert last.hard is not None
    assert whole.hard is not None
    assert last.hard.state() == whole.hard.state()
    assert len(last.hard.state()["errors"]) == 4
    for a, b in zip(whole.model.parameters(), last.model.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert sorted(p.name for p in (tmp_path / "whole").glob("*.pt")) == [
        "tiny-000004.pt", "tiny-000008.pt", "tiny.pt",
    ]  # fmt: skip


def test_hard_pairs_are_the_worst_but_for_the_very_worst() -> None:
    hard = HardPairs(HardShare(share=0.5, ranks=(0.1, 0.3), every_steps=4))
    rng = np.random.default_rng(0)
    keys = [("a.npz", k) for k in range(10)]
    for step in range(4):
        assert hard.draw(step, rng) is None
        hard.note(step, keys, [float(k) for k in range(10)])
    assert hard.draw(4, rng) is None  # its batch was being prepared when the list was made
    drawn = [hard.draw(5, rng) for _ in range(400)]
    assert set(drawn) == {None, ("a.npz", 8), ("a.npz", 7)}
    assert 140 < drawn.count(None) < 260
    again = HardPairs(HardShare(share=0.5, ranks=(0.1, 0.3), every_steps=4))
    again.restore(hard.state())
    assert again.state() == hard.state()


def test_a_size_is_drawn_once_it_has_begun() -> None:
    narrow, wide = Size(0, 64, (64, 48), 2), Size(5, 128, (96, 64), 1)
    rng = np.random.default_rng(0)
    assert {draw_size(4, (narrow, wide), rng) for _ in range(20)} == {narrow}
    assert {draw_size(5, (narrow, wide), rng) for _ in range(20)} == {narrow, wide}
    assert draw_size(5, (), rng) is None


@pytest.mark.parametrize("width", [64, 80, 128])
def test_a_narrower_pair_keeps_its_geometry(width: int) -> None:
    pair = resized(level_pair(0), width)
    height = width * 3 // 4
    assert pair.reference.shape == pair.query.shape == (height, width, 3)
    assert pair.query_depth.shape == (height, width)
    loader = LoaderConfig(batch=1, anchors=32, crop=(56, 40), appearance=False)
    made = crop_pair(pair, loader, np.random.default_rng(1))
    assert made is not None
    batch = collate([made])
    pixels, _ = project(batch.query_from_reference, batch.points, batch.K_query)
    seen = batch.visible > 0
    assert float((pixels - batch.query_pixels).norm(dim=-1)[seen].max()) < 0.02
    assert float(batch.K_query[0, 0]) == pytest.approx(120.0 * width / 128)


@pytest.mark.parametrize(
    ("line", "wrong", "said"),
    [
        ("width: 640", "width: 648", "exceeds the image"),
        ("crop: [320, 256]", "crop: [320, 488]", "exceeds the image"),
        ("crop: [320, 256]", "crop: [321, 256]", "divisible by 8"),
        ("ranks: [0.03, 0.3]", "ranks: [0.3, 0.03]", "do not rise"),
        ("first_step: 0", "first_step: 1", "none begins"),
    ],
)
def test_a_curriculum_that_cannot_be_is_named(tmp_path, line, wrong, said):
    path = tmp_path / "run.yaml"
    path.write_text(SHIPPED.read_text().replace(line, wrong))
    with pytest.raises(ModelError, match=said):
        load_config(path)
