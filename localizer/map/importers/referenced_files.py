"""Finds the files that a mesh or tile refers to, so that changes of a source are detected.

Names are taken from file headers only; errors are left to the importer.
"""

from __future__ import annotations

import gzip
import json
import mmap
import re
import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from localizer.plain_files import decode_lenient

_LONGEST_JSON = 1 << 30
_LONGEST_PACKED = 64 << 20  # of a compressed header
_B3DM_HEADER = 28
_LIBRARY = re.compile(rb"(?im)^(?:\xef\xbb\xbf)?[ \t]*mtllib[ \t]+([^\r\n]+)")
_PICTURE = re.compile(r"(?im)^[ \t]*(?:map_\w+|bump|disp|decal|norm|refl)[ \t]+([^\r\n]+)")


def file_of(folder: Path, name: str) -> Path:
    """The file that a name in a mesh means: as written; else with slashes for backslashes and in
    other letter case (Windows); else, for an absolute path of another machine, the file of that
    name in `folder`. An unknown name is returned as it is. The result may be outside of `folder`.
    """
    plain = folder / name
    if "\0" in name or _exists(plain):
        return plain
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]
    ways = [parts]
    if name[:1] in "/\\" or name[1:2] == ":":
        ways = [parts[-1:]]
    for way in ways:
        path = folder
        for part in way:
            path = _entry(path, part)
        if way and _exists(path):
            return path
    return plain


def _entry(folder: Path, name: str) -> Path:
    """An entry of a folder: with exactly this name, otherwise in any letter case."""
    path = folder / name
    if name == ".." or _exists(path) or not folder.is_dir():
        return path
    return folder / _entries(folder, folder.stat().st_mtime_ns).get(name.casefold(), name)


@lru_cache(maxsize=64)
def _entries(folder: Path, _modified_ns: int) -> dict[str, str]:
    """Names in a folder by their lower-case form; cached, because many files may be missing."""
    names = sorted((entry.name for entry in folder.iterdir()), reverse=True)
    return {name.casefold(): name for name in names}


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that is too long
        return False


def files_beside(path: Path) -> tuple[Path, ...]:
    """Files that an OBJ, glTF, GLB or b3dm refers to, whether they exist or not, sorted by name;
    empty if the file cannot be read.
    """
    if not path.is_file():  # a pipe would never end
        return ()
    try:
        found = set(_of_obj(path) if path.suffix.lower() == ".obj" else _of_gltf(path))
    except (OSError, ValueError, RecursionError, struct.error):
        return ()
    return tuple(sorted(found))


def _of_obj(path: Path) -> Iterator[Path]:
    """Material libraries of an OBJ, and their images."""
    if path.stat().st_size == 0:  # which cannot be mapped
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        libraries = [match[1] for match in _LIBRARY.finditer(text)]
    for names in libraries:
        line = decode_lenient(names)
        for library in {*_named(path.parent, line), *_each(path.parent, line)}:
            yield library
            if library.is_file():
                for match in _PICTURE.finditer(decode_lenient(library.read_bytes())):
                    yield from _named(path.parent, match[1])


def _named(folder: Path, text: str) -> Iterator[Path]:
    """Files of a line: the whole line as a name with blanks, and its last word, before which
    options may stand.
    """
    line = text.strip()
    for name in {line, line.split()[-1]} if line else ():
        yield file_of(folder, name)


def _each(folder: Path, text: str) -> Iterator[Path]:
    """The files that the line's words name: a line may name several libraries."""
    for name in text.split():
        yield file_of(folder, name)


def _of_gltf(path: Path) -> Iterator[Path]:
    """External buffers and images of a glTF."""
    document = _gltf_json(path)
    for kind in ("buffers", "images"):
        entries = document.get(kind)
        for entry in entries if isinstance(entries, list) else ():
            uri = entry.get("uri") if isinstance(entry, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:"):
                name = unquote(urlsplit(uri).path)
                if name and "\0" not in name:
                    yield file_of(path.parent, name)


def _gltf_json(path: Path) -> dict[str, Any]:
    """The JSON of a glTF, or that in the header of a GLB or a b3dm."""
    with path.open("rb") as plain:
        packed = plain.read(2) == b"\x1f\x8b"
    longest = _LONGEST_PACKED if packed else _LONGEST_JSON
    with gzip.open(path) if packed else path.open("rb") as file:
        start = file.read(_B3DM_HEADER)
        begin = 0
        if start[:4] == b"b3dm":
            begin = _B3DM_HEADER + sum(struct.unpack_from("<4I", start, 12))
            file.seek(begin)
            start = file.read(20)
        length = longest
        if start[:4] == b"glTF":
            length = min(struct.unpack_from("<I", start, 12)[0], longest)
            begin += 20
        file.seek(begin)
        document = json.loads(file.read(length))
    return document if isinstance(document, dict) else {}
