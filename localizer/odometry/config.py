"""The odometry's settings: when a keyframe is left, what is believed, how errors grow."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field


class GrowthModel(BaseModel):
    """How the error grows along the way, beside each registration's own covariance.

    Fitted by ``python -m benchmarks.odometry`` (odometry.md). A walk is a sigma per square
    root of a metre flown, from keyframe to keyframe; scale is an error that stays.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    registration: float = Field(
        1.0, ge=1, le=1e4, description="variance factor of each registration's covariance"
    )
    scale: float = Field(ge=0, le=1, description="scale sigma, as a share of the distance")
    horizontal: float = Field(ge=0, le=10, description="walk of east and north, m per root m")
    vertical: float = Field(ge=0, le=10, description="walk of the height, m per root m")
    tilt: float = Field(ge=0, le=1, description="walk of roll and pitch, rad per root m")
    heading: float = Field(ge=0, le=1, description="walk of the heading, rad per root m")
    # Height, tilt and the map's shape mend a pose's other axes, and with them the place that hangs
    # on these. What the registrations took for the place itself nobody mends: without this a night
    # of quality 0.65 was 12.8 m off with a sigma of 1.8 m, inside its 95 % in 39 of 100 frames.
    unmatched: float = Field(
        0.0,
        ge=0,
        le=10,
        description="uncorrected walk of east and north, m per root m, times (1 - quality)",
    )


class OdometryConfig(BaseModel):
    """When a keyframe is left, which registrations count, and how errors grow."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    anchors: int = Field(3000, ge=100, le=8000, description="anchors per keyframe")
    min_overlap: float = Field(
        0.35, ge=0, le=1, description="share of a keyframe's anchors in view of a usable frame"
    )
    min_quality: float = Field(0.2, ge=0, le=1, description="registration quality of a usable one")
    max_sigma_m: float = Field(
        2.0, ge=0.01, le=100, description="position sigma of a usable registration"
    )
    chi2_threshold: float = Field(
        60.0, ge=1, le=1e4, description="squared Mahalanobis distance from the prediction, 6 dof"
    )
    new_below_overlap: float = Field(
        0.7, ge=0, le=1, description="overlap below which a new keyframe starts"
    )
    new_below_quality: float = Field(
        0.6, ge=0, le=1, description="quality, as a share of the keyframe's first, likewise"
    )
    new_beyond_turn_deg: float = Field(
        25.0, ge=1, le=180, description="turn since the keyframe that starts a new one"
    )
    longest_gap_s: float = Field(
        3.0, ge=0.1, le=60, description="time without a usable frame until it is lost"
    )
    longest_sigma_m: float = Field(
        15.0, ge=0.1, le=1000, description="largest sigma of a propagated position"
    )
    acceleration_sigma: float = Field(
        2.0, ge=0.01, le=100, description="m/s², of the motion without usable frames"
    )
    turn_sigma_deg: float = Field(
        0.2, ge=0.01, le=90, description="autopilot's tilt since the keyframe, per axis"
    )
    heading_turn_sigma_deg: float = Field(
        0.6, ge=0.01, le=90, description="its heading since the keyframe"
    )
    rise_sigma_m: float = Field(
        0.3, ge=0.01, le=100, description="barometer's climb since the keyframe"
    )
    terrain: Path | None = Field(None, description="GeoTIFF of ground heights outside the map")
    parallax_noise: float | None = Field(
        0.02, ge=1e-4, le=10, description="sigma of a parallax cost, as a share; null: not used"
    )
    with_map: GrowthModel = Field(
        GrowthModel(
            registration=1.0,
            scale=0.001,
            horizontal=0.02,
            vertical=0.02,
            tilt=5e-4,
            heading=4e-4,
            unmatched=0.3,
        ),
        description="growth with depth from the map",
    )
    with_ground: GrowthModel = Field(
        GrowthModel(
            registration=49.0, scale=0.005, horizontal=0.04, vertical=0.03, tilt=2e-4, heading=1e-3
        ),
        description="growth with depth from a terrain model",
    )
    with_range: GrowthModel = Field(
        GrowthModel(
            registration=49.0, scale=0.045, horizontal=0.04, vertical=0.03, tilt=2e-4, heading=1e-3
        ),
        description="growth with a rangefinder",
    )
    with_plane: GrowthModel = Field(
        GrowthModel(
            registration=49.0, scale=0.1, horizontal=0.04, vertical=0.03, tilt=2e-4, heading=1e-3
        ),
        description="growth over ground taken as level",
    )
