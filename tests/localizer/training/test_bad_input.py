"""What the training says of files that are not what they should be."""

from __future__ import annotations

from concurrent.futures import Future
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from localizer.errors import ModelError, SequenceError  # noqa: E402
from localizer.training import __main__ as cli  # noqa: E402
from localizer.training.curves import plot  # noqa: E402
from localizer.training.data import LoaderConfig, Schedule, ShardStream  # noqa: E402
from localizer.training.export import load_network  # noqa: E402
from localizer.training.shards import read_shard  # noqa: E402


@pytest.mark.parametrize("content", [b"", b"junk", b"\x80\x02}q\x00.", b"PK\x03\x04"])
def test_a_file_that_is_no_checkpoint_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.pt"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"run\.pt: not a"):
        load_network(path)


@pytest.mark.parametrize("state", [[1], {"model": {}}, {"average": {}}])
def test_a_foreign_checkpoint_is_named(tmp_path: Path, state: object) -> None:
    path = tmp_path / "run.pt"
    torch.save(state, path)
    with pytest.raises(ModelError, match=r"run\.pt: (not a checkpoint|holds weights alone)"):
        load_network(path)


@pytest.mark.parametrize("content", [b"", b"junk", b"PK\x03\x04"])
def test_a_file_that_is_no_shard_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "1.npz"
    path.write_bytes(content)
    with pytest.raises(SequenceError, match=r"1\.npz: cannot be read as a shard"):
        read_shard(path)


@pytest.mark.parametrize("content", ["", "step,loss\n", "step,loss\n1,x\n", "a,b\n1,2\n"])
def test_a_file_that_is_no_log_is_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(content)
    with pytest.raises(SequenceError, match=r"run\.csv: not a run's CSV"):
        plot(path)


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


def test_the_command_says_it_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.yaml"
    for content in (b"a: [", b"\xff\xfe", b"a: 2026-13-41", b"a: 1"):
        path.write_bytes(content)
        monkeypatch.setattr("sys.argv", ["training", "train", str(path)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == 2
        assert f"ModelError: {path}: " in capsys.readouterr().err
