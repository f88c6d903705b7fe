"""What the training says of files that are not what they should be."""

from __future__ import annotations

from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from localizer.errors import ModelError, SequenceError  # noqa: E402
from localizer.training import __main__ as cli  # noqa: E402
from localizer.training.checkpoint import read_checkpoint, write_checkpoint  # noqa: E402
from localizer.training.config import TrainConfig, load_config  # noqa: E402
from localizer.training.data.batches import Schedule, ShardStream  # noqa: E402
from localizer.training.data.pairs import SceneConfig  # noqa: E402
from localizer.training.data.shards import read_shard, store  # noqa: E402
from localizer.training.export.export import export, load_network  # noqa: E402
from localizer.training.loop.train import Trainer  # noqa: E402
from localizer.training.models.networks import build  # noqa: E402
from tests.bounds import unbounded  # noqa: E402

SHIPPED = Path(__file__).parents[3] / "configs" / "train_tiny.yaml"


@pytest.mark.parametrize("content", [b"", b"\x80\x02}q\x00.", b"PK\x03\x04"])
def test_a_file_that_is_no_checkpoint_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.pt"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"run\.pt: not a"):
        load_network(path)


@pytest.mark.parametrize("content", [b"", b"junk", b"PK\x03\x04"])
def test_a_file_that_is_no_shard_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "1.npz"
    path.write_bytes(content)
    with pytest.raises(SequenceError, match=r"1\.npz: cannot be read as a shard"):
        read_shard(path)


def test_a_run_ends_with_the_generation_that_it_waits_for(tmp_path: Path) -> None:
    schedule = Schedule((tmp_path / "1.npz",), 1, 0.0, (), 0.0)
    loader = load_config(SHIPPED).optimizer
    for error, named in ((OSError("disk full"), "disk full"), (None, "was not generated")):
        generating: Future[None] = Future()
        if error is None:
            generating.set_result(None)
        else:
            generating.set_exception(error)
        stream = ShardStream(schedule, loader, 0, generating=generating)
        with pytest.raises((OSError, SequenceError), match=named):
            stream.batch(0)
        stream.close()


def test_the_command_says_it_in_a_line(tmp_path, monkeypatch, capsys):
    path = tmp_path / "run.yaml"
    for content in (b"a: [", b"\xff\xfe", b"a: 2026-13-41", b"a: 1"):
        path.write_bytes(content)
        monkeypatch.setattr("sys.argv", ["training", "train", str(path)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == 2
        assert f"ModelError: {path}: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("run", "line", "wrong", "why"),
    [
        ("tiny", "name: tiny", "name: ../tiny", "name"),
        ("tiny", "seed: 1", "seed: -1", "seed"),
        ("tiny", "dilations: [1, 1, 2, 1, 4, 2]", "dilations: []", "dilations"),
        ("tiny", "widths: [24, 48, 96]", "widths: [24, 48, 0]", "widths"),
        ("tiny", "crop: [160, 128]", "crop: [8, 8]", "crop"),
        ("tiny", "learning_rate: 2.0e-3", "learning_rate: .inf", "learning_rate"),
        ("tiny", "seed: 1", "seed: true", "seed"),
        ("tiny", "seed: 1", "seed: 1\nseed: 2", "seed"),
        ("tiny", "\n  steps: 5600", "\n  steps: 10", "decay_steps"),
        ("s0_cpu", "network: s0", "network: s1", "s1"),
        ("s0_cpu", "network: s0", "network: s0\n  widths: [1, 2, 3]", "widths"),
        ("s0", "crop: [512, 512]", "crop: [512, 516]", "divisible by 8"),
        ("s0", "crop: [512, 512]", "crop: [768, 512]", "exceeds the image"),
        ("s0", "active: 16 ", "active: 9000 ", "fewer than active"),
        ("s0", "cells: 1536", "cells: 1500", "cells"),
        ("s0", "live: true", "live: true\n  shards: here", "shards"),
    ],
)
def test_a_value_that_cannot_train_is_named_in_a_line(tmp_path, run, line, wrong, why):
    text = SHIPPED.with_name(f"train_{run}.yaml").read_text()
    assert line in text
    path = tmp_path / "run.yaml"
    path.write_text(text.replace(line, wrong, 1))
    with pytest.raises(ModelError, match=why) as refused:
        load_config(path)
    assert "\n" not in str(refused.value)


def test_a_checkpoint_that_cannot_be_written_leaves_the_older_one(tmp_path, monkeypatch):
    path = tmp_path / "run.pt"
    write_checkpoint(path, {"average": {"step": 1}})

    def full(_: object, partial: Path) -> None:
        partial.write_bytes(b"PK")
        raise RuntimeError("[enforce fail at inline_container.cc:815] . unexpected pos 64 vs 0")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(ModelError, match=r"run\.pt: cannot be written"):
        write_checkpoint(path, {"average": {"step": 2}})
    assert read_checkpoint(path)["average"] == {"step": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_weights_alone_cannot_be_continued(tmp_path: Path) -> None:
    config = load_config(SHIPPED).model_copy(update={"output": tmp_path})
    write_checkpoint(tmp_path / "tiny.pt", {"average": build(config.model).state_dict()})
    with pytest.raises(ModelError, match=r"tiny\.pt: no state to continue from"):
        Trainer(config)


def test_a_model_that_gives_no_numbers_is_not_exported(tmp_path: Path) -> None:
    config = load_config(SHIPPED)
    weights = build(config.model).state_dict()
    for value in weights.values():
        if value.is_floating_point():
            value.fill_(torch.nan)
    state = {"average": weights, "config": config.model_dump(mode="json"), "step": 1, "seconds": 1}
    write_checkpoint(tmp_path / "run.pt", state)
    model = tmp_path / "tiny.onnx"
    model.write_bytes(b"the good one")
    with pytest.raises(ModelError, match="not finite"):
        export(tmp_path / "run.pt", model)
    assert model.read_bytes() == b"the good one"
    assert {p.name for p in tmp_path.iterdir()} == {"run.pt", "tiny.onnx"}


def test_a_stopped_generation_leaves_no_half_shard(tmp_path, monkeypatch):
    def stopped(path: Path, **_: object) -> None:
        path.write_bytes(b"PK")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", stopped)
    with pytest.raises(KeyboardInterrupt):
        store(tmp_path / "1.npz", [], SceneConfig(width=64, height=48))
    assert not list(tmp_path.iterdir())


def test_every_number_of_a_run_has_its_bounds() -> None:
    others = {"data.active", "optimizer.anchors", "optimizer.decay_steps"}  # scenes, crop, steps
    assert unbounded(TrainConfig) == others
