"""The optimizer's constants."""

from __future__ import annotations

from dataclasses import dataclass

from localizer.geometry.pose import Array
from localizer.registration.backend import LMSettings
from localizer.registration.covariance import NoiseModel
from localizer.registration.hypotheses import generate_hypotheses
from localizer.types import PosePrior


@dataclass(frozen=True)
class JNGOConfig:
    """The optimizer's settings; the defaults are the paper's where it gives them."""

    hypotheses: int = 144  # largest size M of the swarm
    box_deg: float = 11.0  # largest pitch and yaw perturbation
    step_deg: float = 2.0  # largest step of the pitch and yaw grid
    translation_sigma_m: float = 1.0  # largest sigma of the perturbation
    # poses drawn from a wide prior at 320 x 240, more in larger images; 0: none
    preselected: int = 2048
    preselected_from_m: float = 2.0  # smallest position sigma of a wide prior
    preselected_to_m: float = 50.0  # largest one
    spread_sigmas: float = 2.2  # grid half-width in prior sigmas
    iterations: tuple[int, ...] = (2, 3, 4)  # LM steps per level, coarse to fine
    # anchors used per level, spread evenly; all by the winner, on the last level
    swarm_anchors: tuple[int, ...] = (250, 500, 500)
    survivors: tuple[int, ...] = (64, 16)  # survivors after each level but the last
    sharpen: int = 6  # the winner's last LM steps, each
    sharpen_damping: float = 0.003  # their first Marquardt factor
    # Geman-McClure scales of these steps, in median residual norms
    sharpen_scales: tuple[float, ...] = (2.0, 1.0, 0.7)
    detail_scales: tuple[float, ...] = (1.0, 0.7)  # likewise on the detail level
    duplicate_px: float = 0.25  # least rms distance of survivors, level px
    huber: float = 0.5  # Huber threshold on the residual norm
    damping: float = 0.03  # first Marquardt factor
    min_overlap: float = 0.25  # least share of anchors in view
    min_anchors: int = 50  # anchors below which nothing is tried
    motion_weight: float = 0.02  # lambda of Eq. 10, in best costs per d²
    prior_weight: float = 0.0001  # weight of a constraint, likewise
    correlation: float = 4.4  # covariance factor of the sums over all anchors, calibrated
    few_anchors: float = 150.0  # anchors in view with which the covariance doubles
    correlation_px: float = 32.0  # image cell within which residuals may correlate
    curvature_px: float = 0.15  # distance at which the cost's curvature is measured, px
    mode_px: float = 5.0  # least distance of another mode from the winner, level px
    covariance_floor: float = 0.05  # least share of the isotropic model
    shape_cells: float = 40.0  # cells that the noise's model shape counts for
    max_sigma_m: float = 50.0  # position sigma that counts as no texture

    @property
    def settings(self) -> LMSettings:
        """Settings for the backends."""
        return LMSettings(self.huber, damping=self.damping, min_overlap=self.min_overlap)

    @property
    def noise(self) -> NoiseModel:
        """Noise model for the covariance."""
        return NoiseModel(
            self.correlation,
            self.covariance_floor,
            self.few_anchors,
            self.shape_cells,
        )

    def swarm(self, prior: PosePrior, seed: int) -> tuple[Array, Array]:
        """Rotations (M, 3, 3) and centres (M, 3), world_from_camera, of hypotheses of a prior."""
        return generate_hypotheses(
            prior,
            self.hypotheses,
            box_deg=self.box_deg,
            step_deg=self.step_deg,
            translation_limit_m=self.translation_sigma_m,
            reach=self.spread_sigmas,
            seed=seed,
        )
