"""A training place: its land, and what stands on it."""

from __future__ import annotations

from dataclasses import dataclass

from localizer.synth.heightfield.scene import Land, Prism
from localizer.types import Float32


@dataclass(frozen=True)
class TrainingPlace:
    """A training place: ground, prisms (buildings and plants) on it and roads. seasons: albedos of
    the same ground at other dates, where the data has them. lasting: (n, n) in 0..1, one where the
    fine texture is the same at all dates: roads, roofs, pavement.
    """

    land: Land
    prisms: list[Prism]
    roads: list[Float32]
    lasting: Float32
    seasons: tuple[Float32, ...] = ()
