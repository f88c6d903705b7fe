"""Limits of an import, and doubts that stop it unless the user accepts them."""

from __future__ import annotations

import math
import stat
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from localizer.errors import MapSourceError

DOUBTS = {
    "area": "a place far outside the area that its CRS is for",
    "datum": "the heights' unit or datum contradicts what was given, or is not known",
    "geoid": "the geoid separation is not that of the place",
    "heights": "heights that no ground on Earth has",
    "mirrored": "a transform that mirrors",
    "nodata": "a value that looks like missing heights and is not marked so",
    "overlap": "orthophoto and surface model hardly share ground",
    "scaled": "a transform that stretches",
    "slope": "a surface as steep as noise",
    "upright": "a ground that does not face up",
    "volume": "content beside the bounding volumes that its tileset states",
}
LOWEST_M, HIGHEST_M = -500.0, 9000.0  # of ground, buildings and mines' edges, in any datum


@dataclass(frozen=True)
class ImportRules:
    """Limits of one import; trusted: names of `DOUBTS` that become warnings."""

    nodes: int = field(default=1_000_000, metadata={"counts": "nodes of a tileset, glTF or raster"})
    depth: int = field(default=200, metadata={"counts": "levels of nodes"})
    file_bytes: int = field(default=1 << 30, metadata={"counts": "bytes of one file"})
    pixels: int = field(default=20_000_000_000, metadata={"counts": "pixels of a raster"})
    texels: int = field(default=1 << 27, metadata={"counts": "pixels of one texture"})
    vertices: int = field(default=200_000_000, metadata={"counts": "vertices of one file"})
    seconds: int = field(default=1800, metadata={"counts": "seconds for reading, or for one tile"})
    memory_mb: int = field(default=8192, metadata={"counts": "MiB of one process"})
    trusted: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        unknown = sorted(self.trusted - set(DOUBTS))
        if unknown:
            raise MapSourceError(
                f"--trust {unknown[0]}: no such doubt; there are {', '.join(DOUBTS)}"
            )
        for name in limit_names():
            if getattr(self, name) < 1:
                raise MapSourceError(f"--limit {name}: must be a whole number from 1 up")
        if self.depth > 300:  # the tree is walked by recursion
            raise MapSourceError("--limit depth: at most 300")

    @classmethod
    def of(cls, limits: Iterable[str] = (), trusted: Iterable[str] = ()) -> ImportRules:
        """From ``NAME=NUMBER`` and names of doubts; `MapSourceError` for invalid ones."""
        given: dict[str, Any] = {}
        for text in limits:
            name, _, number = text.partition("=")
            try:
                value = float(number)
            except ValueError:
                value = math.nan
            if name not in limit_names() or not math.isfinite(value):
                known = ", ".join(f"{k}={v}" for k, v in cls().limits().items())
                raise MapSourceError(f"--limit {text}: give NAME=NUMBER of {known}")
            given[name] = int(value)
        return replace(cls(), **given, trusted=frozenset(trusted))

    def limits(self) -> dict[str, int]:
        """Value of each limit by its name."""
        return {name: getattr(self, name) for name in limit_names()}

    def require(self, name: str, amount: float, where: object) -> None:
        """`MapSourceError`, which names `where`, if `amount` exceeds the limit `name`."""
        limit = getattr(self, name)
        if amount > limit:
            counts = next(f.metadata["counts"] for f in fields(self) if f.name == name)
            raise MapSourceError(
                f"{where}: more than {limit:,} {counts} ({amount:,.0f}); if that is meant, raise "
                f"the limit (--limit {name}={amount:.0f})"
            )

    def accept(self, name: str, text: str) -> str:
        """Return the text of a doubt as a warning if the user accepts doubts of this name;
        otherwise raise it as a `MapSourceError`.
        """
        if name not in self.trusted:
            raise MapSourceError(f"{text}; if that is meant: --trust {name}")
        return text


def limit_names() -> tuple[str, ...]:
    """Names of the limits that an import option may raise."""
    return tuple(f.name for f in fields(ImportRules) if "counts" in f.metadata)


def require_plain_file(path: Path) -> None:
    """`MapSourceError` for a missing file, or a pipe, socket or device, which may block."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise MapSourceError(f"{path} cannot be read: {error.strerror or error}") from error
    if not stat.S_ISREG(mode):
        raise MapSourceError(f"{path} is not a plain file")


DEFAULT_RULES = ImportRules()
