"""Distillation: nothing where student and teacher agree, any width, off unless asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import torch

from localizer.errors import ModelError
from localizer.training.config import DistillSection, TrainConfig, load_config
from localizer.training.data.pairs import SceneConfig
from localizer.training.data.shards import write_shard
from localizer.training.loop.distill import Teacher, distillation_loss
from localizer.training.loop.train import Trainer
from localizer.training.models.s0 import S0Config
from localizer.training.models.tiny import ModelConfig

CONFIGS = Path(__file__).parents[3] / "configs"
SCENES = SceneConfig(cells=256, width=128, height=96, references=3, queries_per_light=3)
PAIRS, ANCHORS = 2, 40


def unit(*shape: int, seed: int) -> torch.Tensor:
    made = torch.randn(*shape, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(made, dim=1)


def pixels(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 6 + torch.rand(PAIRS, ANCHORS, 2, generator=generator) * torch.tensor([12.0, 8.0])


@pytest.fixture
def lesson():
    """Teacher's level, anchors in both views, and their visibility."""
    maps = unit(2 * PAIRS, 12, 20, 24, seed=0)
    trust = torch.full((2 * PAIRS, 20, 24), 0.5)
    return (maps, trust, torch.tensor(12.0)), pixels(1), pixels(2), torch.ones(PAIRS, ANCHORS)


def test_a_student_like_its_teacher_has_nothing_to_learn(lesson) -> None:
    teacher, reference, query, visible = lesson
    maps = teacher[0].clone().requires_grad_()
    loss = distillation_loss((maps, teacher[1]), teacher[2], teacher, reference, query, visible)
    assert float(loss.detach()) == pytest.approx(0.0, abs=1e-5)
    # A rotation of feature space is the same student, although every feature differs.
    basis = torch.linalg.qr(torch.randn(12, 12, generator=torch.Generator().manual_seed(3)))[0]
    turned = torch.einsum("ij,bjhw->bihw", basis, teacher[0])
    loss = distillation_loss((turned, teacher[1]), teacher[2], teacher, reference, query, visible)
    assert float(loss) == pytest.approx(0.0, abs=1e-4)


def test_a_student_of_another_width_comes_closer_to_its_teacher(lesson) -> None:
    teacher, reference, query, visible = lesson
    raw = unit(2 * PAIRS, 7, 20, 24, seed=5).requires_grad_()
    doubt = torch.zeros(2 * PAIRS, 20, 24, requires_grad=True)
    optimizer = torch.optim.Adam([raw, doubt], lr=0.05)
    losses = []
    for _ in range(30):
        student = (torch.nn.functional.normalize(raw, dim=1), torch.sigmoid(doubt - 2.0))
        loss = distillation_loss(student, teacher[2], teacher, reference, query, visible)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.7 * losses[0]
    # The confidence, being learned here, went towards the teacher's half.
    assert float(torch.sigmoid(doubt.detach() - 2.0).mean()) > 0.25


def test_anchors_that_the_teacher_doubts_count_less(lesson) -> None:
    teacher, reference, query, visible = lesson
    maps = unit(2 * PAIRS, 12, 20, 24, seed=9)
    trust = teacher[1].clone()
    trust[:, :, 12:] = 1e-4  # right half
    doubting = (teacher[0], trust, teacher[2])
    left = (reference[..., 0] < 11.5).float()
    some = distillation_loss((maps, trust), teacher[2], doubting, reference, query, visible)
    only = distillation_loss((maps, trust), teacher[2], teacher, reference, query, left)
    assert float(some) == pytest.approx(float(only), rel=0.05)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainConfig, Path]:
    """A small tiny run, and the checkpoint of a small s0."""
    folder = tmp_path_factory.mktemp("distill")
    write_shard(folder, 2000, SCENES, None)
    made = {}
    for name, model in (
        ("train_s0_cpu", S0Config(channels=8, branches=1)),
        ("train_tiny", ModelConfig(channels=16, widths=(8, 8, 16), decoder=(8, 8), dilations=(1,))),
    ):
        run = load_config(CONFIGS / f"{name}.yaml")
        data = run.data.model_copy(update={"shards": folder, "first_seed": 2000, "scenes": 1,
                                           "initial_scenes": 1, "worlds": 0})  # fmt: skip
        o = run.optimizer.model_copy(update={"batch": 2, "anchors": 64, "crop": (64, 48),
                                             "steps": 2, "decay_steps": 1})  # fmt: skip
        made[name] = run.model_copy(update={"output": folder / name, "data": data, "model": model,
                                            "optimizer": o})  # fmt: skip
    teacher = Trainer(made["train_s0_cpu"])
    teacher.run(steps=1)
    return made["train_tiny"], teacher.checkpoint


def test_tiny_learns_from_s0(runs: tuple[TrainConfig, Path], tmp_path: Path) -> None:
    config, checkpoint = runs
    curves = {}
    for name, weight in (("alone", None), ("taught", 0.5)):
        distill = None if weight is None else DistillSection(teacher=checkpoint, weight=weight)
        trainer = Trainer(config.model_copy(update={"output": tmp_path / name, "distill": distill}))
        trainer.run()
        curves[name] = (tmp_path / name / "tiny.csv").read_text().splitlines()[0].split(",")
    assert {"distill_0", "distill_1", "distill_2"} == set(curves["taught"]) - set(curves["alone"])


def test_a_teacher_of_coarser_levels_alone_is_refused(runs: tuple[TrainConfig, Path]) -> None:
    pupil, _ = runs
    coarse = Trainer(pupil)
    coarse.run(steps=1)  # strides 8, 4, 2: nothing for a level at 1
    with pytest.raises(ModelError, match="stride 1"):
        Teacher(coarse.checkpoint, (4, 2, 1), torch.device("cpu"))


def test_levels_are_brought_to_the_students_strides(runs: tuple[TrainConfig, Path]) -> None:
    teacher = Teacher(runs[1], (8, 4, 2), torch.device("cpu"))
    levels = teacher.levels(torch.rand(1, 3, 32, 48))
    assert [f.shape for f, _, _ in levels] == [(1, 8, 4, 6), (1, 8, 8, 12), (1, 8, 16, 24)]
    for features, confidence, _ in levels:
        torch.testing.assert_close(features.norm(dim=1), torch.ones_like(confidence), atol=1e-3,
                                   rtol=0)  # fmt: skip


def test_no_shipped_run_has_a_teacher() -> None:
    runs = sorted(CONFIGS.glob("train_*.yaml"))
    assert runs
    for path in runs:
        assert load_config(path).distill is None, path
