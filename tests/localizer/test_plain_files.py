"""Files that are read by name: plain ones, whole, and nothing that keeps a reader waiting."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from localizer.errors import CameraError, MapCacheError, PoseFileError
from localizer.geometry.camera import Camera
from localizer.geometry.posefile import read_poses
from localizer.geometry.trajectory import read_tum
from localizer.map.cache.cache import TileCache
from localizer.plain_files import files_of, plain_bytes, plain_text


def test_a_plain_file_is_read_whole_up_to_its_bound(tmp_path):
    path = tmp_path / "a"
    path.write_bytes("é\r\n".encode())
    assert plain_text(path) == "é\r\n"
    assert plain_bytes(path, 4) == plain_bytes(path, None) == path.read_bytes()
    with pytest.raises(OSError, match="is larger than 0 MiB"):
        plain_bytes(path, 3)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_text_is_read_whatever_editor_saved_it(tmp_path, encoding):
    """Notepad writes a byte order mark, and CRLF."""
    path = tmp_path / "poses.txt"
    path.write_bytes("# name lon lat\r\nß.jpg 8 47 500 0 0 0\r\n".encode(encoding))
    assert plain_text(path).startswith("# name")
    assert [row.name for row in read_poses(path)] == ["ß.jpg"]


def test_another_encoding_is_a_named_error(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_bytes("ß.jpg 8 47 500 0 0 0\n".encode("cp1252"))
    with pytest.raises(PoseFileError, match="save the file as UTF-8"):
        read_poses(path)


def test_the_files_of_a_folder_are_the_users(tmp_path):
    """A Mac puts ._NAME beside each NAME that it copies to a stick."""
    for name in ("b.JPG", "._b.JPG", "a.jpg", ".hidden.jpg", "a.txt"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "folder.jpg").mkdir()
    assert [p.name for p in files_of(tmp_path, (".jpg",))] == ["a.jpg", "b.JPG"]


def test_a_link_to_a_plain_file_is_one(tmp_path):
    (tmp_path / "a").write_text("x")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert plain_text(tmp_path / "b") == "x"


@pytest.mark.parametrize(
    ("read", "error"),
    [(read_poses, PoseFileError), (read_tum, PoseFileError), (Camera.from_json, CameraError)],
)
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_file_is_a_named_error(tmp_path, read, error, kind):
    path = tmp_path if kind == "folder" else Path("/dev/zero")
    if kind == "pipe":
        path = tmp_path / "pipe"
        os.mkfifo(path)
    with pytest.raises(error, match=f"{path}.*(is not a plain file|directory: '{path}')"):
        read(path)


def test_json_that_nests_without_end_or_repeats_a_key_is_a_named_error(tmp_path):
    path = tmp_path / "camera.json"
    for text in ("[" * 100_000, '{"fx": 500, "fx": 900}'):
        path.write_text(text)
        with pytest.raises(CameraError, match="cannot be read as JSON"):
            Camera.from_json(path)
    (tmp_path / "manifest.json").write_text("[" * 100_000)
    with pytest.raises(MapCacheError, match="cannot be read as JSON"):
        TileCache.open(tmp_path)
