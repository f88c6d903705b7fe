"""A small file is replaced as a whole, privately, and through nobody's link."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mavlink_bridge.atomic_file import read_small_file, replace_file


def test_the_new_text_stands_in_the_place_of_the_old_and_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    for text in ("a" * 10_000, "\u00e9"):
        replace_file(path, text, durable=True)
        assert path.read_text(encoding="utf-8") == text
    assert path.stat().st_mode & 0o777 == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_what_fails_leaves_the_old_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "state.json"
    replace_file(path, "old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mavlink_bridge.atomic_file.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        replace_file(path, "new", durable=True)
    assert path.read_text(encoding="utf-8") == "old"
    monkeypatch.undo()
    replace_file(path, "new", durable=True)  # what the failure left is no obstacle
    assert path.read_text(encoding="utf-8") == "new"


def test_a_link_that_was_laid_beside_it_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine", encoding="utf-8")
    (tmp_path / ".state.json.tmp").symlink_to(victim)
    replace_file(tmp_path / "state.json", "new")
    assert victim.read_text(encoding="utf-8") == "mine"


def test_a_pipe_a_link_and_what_has_no_end_are_not_read(tmp_path: Path) -> None:
    """A pipe at the replay window's place kept the companion from starting; a sparse file of a
    gigabyte at that of the gate or of the last fix took six of memory and half a minute.
    """
    small, endless = tmp_path / "small", tmp_path / "endless"
    replace_file(small, "x" * 1000)
    assert read_small_file(small) == "x" * 1000
    with endless.open("wb") as file:
        file.truncate(1 << 34)
    (tmp_path / "link").symlink_to(small)
    os.mkfifo(tmp_path / "pipe")
    for name, why in (("endless", "larger"), ("link", "symbolic"), ("pipe", "no plain file")):
        with pytest.raises(OSError, match=why):
            read_small_file(tmp_path / name)
