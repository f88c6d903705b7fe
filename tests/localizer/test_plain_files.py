"""Files that are read by name: plain ones, whole, and nothing that keeps a reader waiting."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import yaml

from localizer.errors import CameraError, MapCacheError, PoseFileError
from localizer.geometry.camera import Camera
from localizer.geometry.trajectory import read_poses, read_tum
from localizer.map.cache.cache import TileCache
from localizer.plain_files import files_of, load_yaml, plain_bytes, plain_text


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


# --- Strict YAML: what a settings file may not say ----------------------------------------------


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("a: 1\nb: 2\na: 3\n", "line 3, column 1"),
        ("top:\n  rate: 1\n  rate: 1\n", "line 3, column 3"),
        ("- {x: 1, y: 2, x: 1}\n", "line 1, column 16"),
        ("1: a\n0x1: b\n", "line 2, column 1"),
    ],
)
def test_a_key_that_stands_twice_is_refused_with_its_place(text: str, where: str) -> None:
    with pytest.raises(yaml.YAMLError, match="stands twice") as error:
        load_yaml(text)
    assert where in str(error.value)


def test_the_same_key_in_two_mappings_is_no_repetition() -> None:
    assert load_yaml("a: {x: 1}\nb: {x: 2}\n") == {"a": {"x": 1}, "b": {"x": 2}}


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("base: &b {x: 1}\nown: {<<: *b, y: 3}\n", "line 2, column 7"),
        ("base: &b {x: 1}\nown:\n  <<: [*b, *b]\n", "line 3, column 3"),
        ("base: &b {x: 1}\nown: {!!merge any: *b}\n", "line 2, column 7"),
        ("base: &b {x: 1}\nown: {? !!merge [x] : *b}\n", "line 2, column 9"),
    ],
)
def test_a_merge_key_is_refused_with_its_place(text: str, where: str) -> None:
    with pytest.raises(yaml.YAMLError, match="the merge key << is not read") as error:
        load_yaml(text)
    assert where in str(error.value)


def test_an_alias_and_a_quoted_merge_key_are_read() -> None:
    assert load_yaml("base: &b {x: 1}\nown: *b\n")["own"] == {"x": 1}
    assert load_yaml("'<<': 1\n") == {"<<": 1}


@pytest.mark.parametrize("text", ["!!python/object/apply:os.system ['true']", "? [a]\n: 1\n"])
def test_it_makes_plain_types_only(text: str) -> None:
    with pytest.raises(yaml.YAMLError):
        load_yaml(text)


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("fx: 8:20\n", "base 60, as 500"),
        ("fx: 8:20.5\n", "base 60, as 500.5"),
        ("fx: -1:30\n", "base 60, as -90"),
        ("fx: 0100\n", "base 8, as 64"),
        ("8:20: fx\n", "base 60, as 500"),
        ("k: [0.1, {deep: 1:00}]\n", "base 60, as 60"),
    ],
)
def test_a_number_that_says_another_one_is_refused(text: str, read: str) -> None:
    with pytest.raises(yaml.YAMLError, match=read) as error:
        load_yaml(text)
    assert "line 1, column" in str(error.value)


def test_plain_numbers_and_text_with_colons_are_read_as_they_stand() -> None:
    text = "a: 500\nb: 1_000\nc: 0x10\nd: '8:20'\ne: udp://127.0.0.1:5600\nf: 0\ng: 0.5\nh: -07.5"
    assert load_yaml(text) == {
        "a": 500, "b": 1000, "c": 16, "d": "8:20", "e": "udp://127.0.0.1:5600", "f": 0, "g": 0.5,
        "h": -7.5,
    }  # fmt: skip
