"""Interface between importers and builder: a tree of nodes whose tiles are loaded on demand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.types import Float32, Image

VerticalDatum = Literal["ellipsoidal", "amsl"]


@dataclass(frozen=True, eq=False)
class SourceMesh:
    """Triangles with one texture, as an importer reads it.

    positions: (V, 3) float64, in the importer's frame; uvs: (V, 2) float32, v down; faces: (F, 3)
    int32; image: (h, w, 3) uint8 RGB; jpeg: the image's own bytes where it is a JPEG that was not
    changed; palette: the image is a grid of flat colours that mips would mix.
    """

    positions: Array
    uvs: Float32
    faces: NDArray[np.int32]
    image: Image
    jpeg: bytes | None = None
    repeat: bool = False
    palette: bool = False


class TileSource(Protocol):
    """One tile that can be imported in any process (it can be pickled)."""

    @property
    def name(self) -> str:
        """Name for errors."""
        ...

    def load(self) -> Sequence[SourceMesh]:
        """Meshes with positions in ECEF metres; raises `MapSourceError`."""
        ...


@dataclass(frozen=True, eq=False)
class SourceNode:
    """One node of the tile tree. geometric_error: m. replaces: its children replace it (REPLACE),
    else they are added (ADD). corners: (8, 3) ECEF metres of a box that holds its tiles; None: not
    stated. stands_in: its surface can be shown where children are missing.
    """

    geometric_error: float
    replaces: bool
    tiles: Sequence[TileSource]
    children: list[SourceNode] = field(default_factory=list)
    corners: Array | None = None
    stands_in: bool = True

    def walk(self) -> Iterator[SourceNode]:
        """This node and everything below it, parents first."""
        stack = [self]
        while stack:
            node = stack.pop()
            yield node
            stack.extend(reversed(node.children))


@dataclass(frozen=True, eq=False)
class SourceTree:
    """A map source.

    centre: (3,) ECEF metres. geoid_separation_m, attribution, vertical_datum, imagery_date, sensor:
    as far as the source states them. files: all files of the source, so that a change is detected;
    options: further inputs of the tree. vertical_crs: the source's own statement of
    `vertical_datum`, empty if that follows from the format. warnings: doubts that did not stop the
    import. up_axis: axis by which its meshes were read; None: it has none.
    """

    root: SourceNode
    centre: Array
    geoid_separation_m: float | None
    attribution: str
    files: tuple[Path, ...]
    vertical_datum: VerticalDatum | None = None
    options: str = ""
    vertical_crs: str = ""
    warnings: tuple[str, ...] = ()
    imagery_date: str | None = None
    sensor: str | None = None
    up_axis: str | None = None
