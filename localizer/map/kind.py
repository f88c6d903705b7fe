"""Kind of a tile cache: what its heights contain, detail of the imagery, and its date.

`map build` measures it (`localizer.map.inspection.kind`) and keeps it in the manifest.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import date
from typing import Literal

from pydantic import StrictFloat

Heights = Literal["surface", "terrain", "flat"]
IMAGERY_DATE = r"\d{4}(-(0[1-9]|1[0-2])(-(0[1-9]|[12]\d|3[01]))?)?"  # a year, a month or a day
RESOLUTION_M = (1e-4, 100.0)  # of imagery

# A surface model's own error where nothing has changed since. Caliterra's, against points that its
# photos did not make: half of them within 0.1 m, 90 % within 0.33 m.
_SURFACE_SIGMA_M = 0.3
# Root mean square of what stands above the ground, over ground and roofs together: 1.5 m on a
# construction site (caliterra), 3.8 m in quito, 5.4 m in a village among trees (portugal), 2.4 m at
# the edge of a generated town and 6.1 m in its centre.
_TOWN_SIGMA_M = 6.0
# What a flat model lacks besides: relief within the ground that one image shows.
_RELIEF_SIGMA_M = 2.0
USUAL_HEIGHT_M = 120.0  # above the ground: the highest that is allowed in most countries
_GOOD_ATTITUDE_DEG = 1.0  # of roll and pitch, which a calibrated gimbal keeps
HEIGHTS_HOLD = {
    "surface": "surface with buildings and trees",
    "terrain": "terrain without buildings",
    "flat": "flat: neither terrain nor buildings",
}


@dataclass(frozen=True)
class MapKind:
    """Properties of a map that determine the accuracy.

    heights: "surface" (with buildings and trees), "terrain" (bare ground, or a surface too coarse
    for buildings) or "flat" (one plane). unknown_height_sigma_m: RMS over the whole ground of the
    object heights that the map lacks; a roof or a block has one height. effective_resolution_m:
    side of the smallest square that the imagery resolves, by its spectrum; at least the size of a
    texel. imagery_date: as 2024, 2024-06 or 2024-06-30; sensor: as the source names it, with "?"
    for unprintable characters. None: not known. ValueError for an invalid value.
    """

    heights: Heights
    unknown_height_sigma_m: StrictFloat
    effective_resolution_m: StrictFloat
    imagery_date: str | None = None
    sensor: str | None = None

    def __post_init__(self) -> None:
        if self.heights not in UNKNOWN_HEIGHT_SIGMA_M:
            known = ", ".join(UNKNOWN_HEIGHT_SIGMA_M)
            raise ValueError(f"heights {self.heights!r}: one of {known}")
        for name, low, high in (
            ("unknown_height_sigma_m", 0.0, 1000.0),
            ("effective_resolution_m", *RESOLUTION_M),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} {value!r}: metres from {low:g} to {high:g}")
        if self.imagery_date and not re.fullmatch(IMAGERY_DATE, self.imagery_date):
            raise ValueError(f"imagery_date {self.imagery_date!r}: as 2024, 2024-06 or 2024-06-30")
        if self.sensor:  # a terminal would obey its control sequences
            plain = "".join(c if c.isprintable() else "?" for c in self.sensor)
            object.__setattr__(self, "sensor", plain)

    @property
    def has_buildings(self) -> bool:
        """Whether the heights contain buildings and trees."""
        return self.heights == "surface"

    def line(self) -> str:
        """One line: kind of heights, resolution of the imagery, date and sensor."""
        parts = [
            HEIGHTS_HOLD[self.heights],
            f"imagery resolves {self.effective_resolution_m:.2f} m",
        ]
        parts += [part for part in (self.imagery_date, self.sensor) if part]
        return "; ".join(parts)

    def advice(self, half_view_deg: float, height_m: float = USUAL_HEIGHT_M) -> str:
        """Expected error and advice, in words; empty if the heights contain buildings."""
        if self.has_buildings:
            return ""
        expected = self.expected_error_m(height_m, half_view_deg, _GOOD_ATTITUDE_DEG)
        return (
            f"no buildings in the heights: expect {expected:.0f} m at {height_m:.0f} m above the "
            f"ground, give attitude to {_GOOD_ATTITUDE_DEG:g} deg"
        )

    def imagery_age(self, today: date, max_days: int) -> tuple[str, bool]:
        """Age of the imagery in words, and whether it is known and within a limit.

        A year or a month counts as its first day, so that the age is the largest possible one. A
        date after `today` gives a negative age, which is within any limit.
        """
        if not self.imagery_date:
            return "date not known", False
        year, month, day = (int(n) for n in f"{self.imagery_date}-01-01".split("-")[:3])
        try:
            days = (today - date(year, month, day)).days
        except ValueError:  # a 31 June that a source stated
            return f"{self.imagery_date} is no date", False
        return f"{self.imagery_date} ({days} days ago)", days <= max_days

    def expected_error_m(
        self, height_m: float, half_view_deg: float, attitude_sigma_deg: float
    ) -> float:
        """Horizontal error (1 sigma) of one registration that looks about straight down.

        height_m: above the ground; half_view_deg: half of the field of view; attitude_sigma_deg: of
        roll and pitch. Without the parallax of buildings an image does not separate a tilt from a
        shift, so the attitude's error shifts the position. A roof of unknown height h at an angle a
        from nadir shifts it by h tan a. With buildings in the map, only `unknown_height_sigma_m`
        counts.
        """
        lean = math.tan(math.radians(half_view_deg)) / math.sqrt(3)  # its rms over the image
        if self.has_buildings:
            return self.unknown_height_sigma_m
        tilt = height_m * math.tan(math.radians(attitude_sigma_deg))
        return math.hypot(tilt, self.unknown_height_sigma_m * lean)


UNKNOWN_HEIGHT_SIGMA_M: dict[str, float] = {
    "surface": _SURFACE_SIGMA_M,
    "terrain": _TOWN_SIGMA_M,
    "flat": math.hypot(_TOWN_SIGMA_M, _RELIEF_SIGMA_M),
}
