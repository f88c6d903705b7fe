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
from localizer.training.data.batches import LoaderConfig, Schedule, ShardStream  # noqa: E402
from localizer.training.data.pairs import SceneConfig  # noqa: E402
from localizer.training.data.shards import read_shard, store  # noqa: E402
from localizer.training.export.export import export, load_network  # noqa: E402
from localizer.training.loop.train import Trainer  # noqa: E402
from localizer.training.models.networks import build  # noqa: E402
from tests.bounds import unbounded  # noqa: E402

SHIPPED = Path(__file__).parents[3] / "configs" / "train_tiny.yaml"


@pytest.mark.parametrize("content", [b"", b"junk", b"\x80\x02}q\x00.", b"PK\x03\x04"])
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
    loader = LoaderConfig(batch=1, anchors=64, crop=(96, 64), appearance=False)
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
    ("line", "wrong"),
    [
        ("name: tiny", "name: ../tiny"),
        ("seed: 1", "seed: -1"),
        ("dilations: [1, 1, 2, 1, 4, 2]", "dilations: []"),
        ("widths: [24, 48, 96]", "widths: [24, 48, 0]"),
        ("crop: [160, 128]", "crop: [8, 8]"),
        ("learning_rate: 2.0e-3", "learning_rate: .inf"),
        ("seed: 1", "seed: true"),
        ("seed: 1", "seed: 1\nseed: 2"),
    ],
)
def test_a_value_that_cannot_train_is_named_in_a_line(tmp_path, line, wrong):
    text = SHIPPED.read_text()
    assert line in text
    path = tmp_path / "run.yaml"
    path.write_text(text.replace(line, wrong, 1))
    with pytest.raises(ModelError, match=wrong.partition(":")[0]) as refused:
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
