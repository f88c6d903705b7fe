"""Constants of relocalization."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RelocalizationConfig:
    """Effort of the search, and limits for its result."""

    threads: int = 2  # CPU threads of a search, which runs while no position is known
    cache_mib: int = 128  # resident tiles, MiB
    spectra_mib: int = 192  # map transforms kept between searches, MiB
    # A patch of 130 m is blurred by two cells at its edge when it is turned by 3 degrees or scaled
    # by 5 %: with 10 degrees, 1.15 and 170 m the right place fell from first to behind 60th.
    heading_step_deg: float = 6.0  # step between headings
    heading_reach: float = 2.0  # range of headings, in sigmas
    scale_step: float = 1.1  # ratio of neighbouring heights above ground
    extraction_ratio: float = 1.35  # ratio of heights that share one feature extraction
    patch_m: float = 128.0  # largest side of the compared ground, at 0.5 m a pixel
    strip_m: float = 340.0  # largest side of the ground of several frames, 120 m above it
    candidates: int = 96  # largest number of candidates rendered at half size
    finalists: int = 4  # of these, the number that is registered
    passes: int = 3  # renderings of a candidate, each from the last pose
    min_overlap: float = 0.5  # share of the anchors in view
