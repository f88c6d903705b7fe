"""Settings of relocalization."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class RelocalizationConfig(BaseModel):
    """Effort of the search, and limits for its result."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    threads: int = Field(1, ge=1, le=64, description="CPU threads of a search")
    cache_mib: int = Field(128, ge=16, le=1 << 20, description="resident tiles, MiB")
    spectra_mib: int = Field(
        256, ge=0, le=1 << 20, description="map transforms kept between searches"
    )
    # A patch of 130 m is blurred by two cells at its edge when it is turned by 3 degrees or scaled
    # by 5 %: with 10 degrees, 1.15 and 170 m the right place fell from first to behind 60th.
    heading_step_deg: float = Field(6.0, ge=1, le=45, description="step between headings")
    heading_reach: float = Field(2.0, ge=0.5, le=6, description="range of headings, in sigmas")
    scale_step: float = Field(
        1.1, ge=1.02, le=1.5, description="ratio of neighbouring heights above ground"
    )
    extraction_ratio: float = Field(
        1.35, ge=1.0, le=2.0, description="ratio of heights that share one feature extraction"
    )
    patch_m: float = Field(
        128.0, ge=40, le=2000, description="largest side of the compared ground, at 0.5 m a pixel"
    )
    candidates: int = Field(
        96, ge=1, le=400, description="largest number of candidates rendered at half size"
    )
    finalists: int = Field(4, ge=1, le=100, description="of these, the number that is registered")
    passes: int = Field(
        3, ge=1, le=10, description="renderings of a candidate, each from the last pose"
    )
    min_overlap: float = Field(0.5, ge=0, le=1, description="share of the anchors in view")
