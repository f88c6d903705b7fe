"""The optimizer's settings."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from localizer.geometry.pose import Array
from localizer.registration.backend import LMSettings
from localizer.registration.covariance import NoiseModel
from localizer.registration.hypotheses import generate_hypotheses
from localizer.types import PosePrior

_Steps = Annotated[int, Field(ge=0, le=1000)]
_Count = Annotated[int, Field(ge=1, le=8000)]
_Scale = Annotated[float, Field(ge=0.01, le=100)]


class JNGOConfig(BaseModel):
    """The optimizer's settings; the defaults are the paper's where it gives them."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    hypotheses: int = Field(default=144, ge=1, le=4096, description="largest size M of the swarm")
    box_deg: float = Field(
        default=11.0, ge=0.01, le=90, description="largest pitch and yaw perturbation"
    )
    step_deg: float = Field(
        default=2.0, ge=0.001, le=90, description="largest step of the pitch and yaw grid"
    )
    translation_sigma_m: float = Field(
        default=1.0, ge=0, le=100, description="largest sigma of the perturbation"
    )
    preselected: int = Field(
        default=2048,
        ge=0,
        le=65536,
        description="poses drawn from a wide prior at 320 x 240, more in larger images; 0: none",
    )
    preselected_from_m: float = Field(
        default=2.0, ge=0, le=1e4, description="smallest position sigma of a wide prior"
    )
    preselected_to_m: float = Field(default=50.0, ge=0, le=1e4, description="largest one")
    spread_sigmas: float = Field(
        default=2.2, ge=0.01, le=100, description="grid half-width in prior sigmas"
    )
    iterations: tuple[_Steps, ...] = Field(
        default=(2, 3, 4), min_length=1, description="LM steps per level, coarse to fine"
    )
    swarm_anchors: tuple[_Count, ...] = Field(
        default=(250, 500, 500),
        min_length=1,
        description="anchors used per level, spread evenly; all by the winner, on the last level",
    )
    keep: tuple[_Count, ...] = Field(
        default=(64, 16), description="survivors after each level but the last"
    )
    sharpen: int = Field(default=6, ge=0, le=1000, description="the winner's last LM steps, each")
    sharpen_damping: float = Field(
        default=0.003, ge=1e-9, le=1e6, description="their first Marquardt factor"
    )
    sharpen_scales: tuple[_Scale, ...] = Field(
        default=(2.0, 1.0, 0.7),
        description="Geman-McClure scales of these steps, in median residual norms",
    )
    detail_scales: tuple[_Scale, ...] = Field(
        default=(1.0, 0.7), description="likewise on the detail level"
    )
    distinct_px: float = Field(
        default=0.25, ge=0, le=1000, description="least rms distance of survivors, level px"
    )
    huber: float = Field(
        default=0.5, ge=1e-3, le=1000, description="Huber threshold on the residual norm"
    )
    damping: float = Field(default=0.03, ge=1e-9, le=1e6, description="first Marquardt factor")
    min_overlap: float = Field(
        default=0.25, gt=0, le=1, description="least share of anchors in view"
    )
    min_anchors: int = Field(
        default=50, ge=6, le=8000, description="anchors below which nothing is tried"
    )
    motion_weight: float = Field(
        default=0.02, ge=0, le=1e4, description="lambda of Eq. 10, in best costs per d²"
    )
    prior_weight: float = Field(
        default=0.0001, ge=0, le=1e4, description="weight of a constraint, likewise"
    )
    correlation: float = Field(
        default=4.4,
        ge=0.01,
        le=1000,
        description="covariance factor of the sums over all anchors, calibrated",
    )
    few_anchors: float = Field(
        default=150.0, ge=0, le=1e5, description="anchors in view with which the covariance doubles"
    )
    correlation_px: float = Field(
        default=32.0, ge=1, le=4096, description="image cell within which residuals may correlate"
    )
    curvature_px: float = Field(
        default=0.15,
        ge=0.01,
        le=10,
        description="distance at which the cost's curvature is measured, px",
    )
    mode_px: float = Field(
        default=5.0,
        ge=0,
        le=4096,
        description="least distance of another mode from the winner, level px",
    )
    covariance_floor: float = Field(
        default=0.05, ge=0, le=1, description="least share of the isotropic model"
    )
    shape_cells: float = Field(
        default=40.0, ge=0, le=1e6, description="cells that the noise's model shape counts for"
    )
    map_error_m2: float = Field(
        default=0.13,
        ge=0,
        le=1e4,
        description="displacement of the map (sigma) times its correlation length",
    )
    max_sigma_m: float = Field(
        default=50.0, ge=0.01, le=1000, description="position sigma that counts as no texture"
    )

    @property
    def settings(self) -> LMSettings:
        """What the backends need of it."""
        return LMSettings(self.huber, damping=self.damping, min_overlap=self.min_overlap)

    @property
    def noise(self) -> NoiseModel:
        """What the covariance needs of it."""
        return NoiseModel(
            self.correlation,
            self.covariance_floor,
            self.few_anchors,
            self.shape_cells,
            self.map_error_m2,
        )

    def swarm(self, prior: PosePrior, seed: int) -> tuple[Array, Array]:
        """Rotations (M, 3, 3) and centres (M, 3) of the hypotheses about a prior."""
        return generate_hypotheses(
            prior,
            self.hypotheses,
            box_deg=self.box_deg,
            step_deg=self.step_deg,
            translation_limit_m=self.translation_sigma_m,
            reach=self.spread_sigmas,
            seed=seed,
        )
