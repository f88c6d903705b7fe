"""Reads files without blocking and with size limits, in any usual text encoding, and lists a
folder's visible files. Reads JSON and YAML strictly: plain types, no repeated or merge keys, no
`yes` for a number, and no sexagesimal or octal numbers of YAML 1.1 (8:20 is 500).
"""

from __future__ import annotations

import codecs
import errno
import json
import os
import re
import stat
from collections.abc import Collection, Hashable, Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

import yaml

MOST_BYTES = 1 << 28  # of text and pictures; what is longer is another file, given by mistake


@contextmanager
def open_plain(path: Path) -> Iterator[BufferedReader]:
    """A plain file, opened for reading. OSError for a pipe, which may block the reader, and for a
    device, which may have no end.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "is not a plain file", str(path))
        yield file


def plain_bytes(path: Path, most: int | None = MOST_BYTES) -> bytes:
    """Content of a plain file. most: size limit in bytes; None: no limit.

    OSError as `open_plain`, and for more than `most` bytes.
    """
    with open_plain(path) as file:
        data = file.read(-1 if most is None else most + 1)
    if most is not None and len(data) > most:
        raise OSError(errno.EFBIG, f"is larger than {most >> 20} MiB", str(path))
    return data


def plain_text(path: Path, most: int | None = MOST_BYTES) -> str:
    """Text of a plain file; limit and errors as `plain_bytes`, encodings as `as_text`."""
    return as_text(plain_bytes(path, most))


def as_text(data: bytes) -> str:
    """Decode UTF-8, or UTF-16 with a byte order mark, which is removed. UnicodeDecodeError for
    another encoding.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        error.reason += "; save the file as UTF-8"
        raise


def decode_lenient(data: bytes) -> str:
    """Decode text as `as_text`; in another encoding, non-ASCII characters are replaced."""
    try:
        return as_text(data)
    except UnicodeDecodeError:
        return data.decode("utf-8-sig", "replace")


def without_hidden(paths: Iterable[Path]) -> list[Path]:
    """The paths, sorted, without those whose name begins with a dot: hidden files, and macOS's
    ``._NAME`` files (AppleDouble).
    """
    return sorted(p for p in paths if not p.name.startswith("."))


def files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """A folder's visible files with these suffixes, sorted by name; subfolders are not searched.
    suffixes: lower case, with the dot; the files' own may be upper case.
    """
    return without_hidden(
        p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file()
    )


_OCTAL = re.compile(r"[-+]?0[0-9_]+")


class _StrictLoader(yaml.SafeLoader):
    """A safe loader that refuses a repeated key and the merge key `<<`.

    Releases of PyYAML expand merges differently, and nested merges can grow ninefold with each
    line. No setting needs a merge.
    """

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(
                    None, None,
                    "the merge key << is not read: write out its keys (or quote it as text)",
                    key_node.start_mark,
                )  # fmt: skip
            if not isinstance(key_node, yaml.ScalarNode):
                continue
            key = self.construct_object(key_node)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key!r} stands twice in one mapping", key_node.start_mark
                )
            seen.add(key)
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """An integer, if its notation is decimal or explicit."""
        return int(_plain(node, super().construct_yaml_int(node)))

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """A float, if its notation is decimal."""
        return float(_plain(node, super().construct_yaml_float(node)))


for _kind, _read in (
    ("int", _StrictLoader.construct_yaml_int), ("float", _StrictLoader.construct_yaml_float),
):  # fmt: skip
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _read)


def _plain(node: yaml.ScalarNode, number: float) -> float:
    """The number of a scalar; an error if YAML 1.1 reads it to base 60 or 8."""
    text = str(node.value)
    if ":" in text or _OCTAL.fullmatch(text):
        base = "60" if ":" in text else "8"
        raise yaml.constructor.ConstructorError(
            None, None,
            f"{text!r} is read to base {base}, as {number:g}: write decimal digits with a point, "
            "or in quotes where it is text", node.start_mark,
        )  # fmt: skip
    return number


def load_yaml(text: str) -> Any:
    """Parse a YAML document. yaml.YAMLError, with line and column, also for a repeated key, a merge
    key and a number to base 60 or 8.

    ValueError for an impossible date, or a tag that its value does not fit; RecursionError for
    endless nesting.
    """
    try:
        return yaml.load(text, Loader=_StrictLoader)
    except (AttributeError, LookupError) as error:  # PyYAML, of `!!bool x`, `!!timestamp x`
        raise ValueError(f"a tag does not fit its value ({error})") from error


def load_json(text: str) -> Any:
    """Parse a JSON document. ValueError, also for a repeated key: the last would win silently."""
    return json.loads(text, object_pairs_hook=_told_once)


def _told_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands twice")
    return found


def misread_booleans(
    given: Any, taken: Any, where: tuple[str | int, ...] = ()
) -> Iterator[tuple[tuple[str | int, ...], bool]]:
    """Yield (key path, value) of booleans that became numbers, as pydantic converts yes, on and
    true. given: the parsed YAML; taken: the pydantic model that was made of it; where: the key path
    of both.
    """
    if isinstance(given, bool):
        if isinstance(taken, int | float) and not isinstance(taken, bool):
            yield where, given
    elif isinstance(given, dict):
        for name, value in given.items():
            inner = taken.get(name) if isinstance(taken, dict) else getattr(taken, name, value)
            yield from misread_booleans(value, inner, (*where, name))
    elif isinstance(given, list) and isinstance(taken, list | tuple):
        for i, (value, inner) in enumerate(zip(given, taken, strict=False)):
            yield from misread_booleans(value, inner, (*where, i))
