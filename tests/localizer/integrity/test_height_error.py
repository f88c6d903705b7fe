"""What a map without buildings does to a pose, and what shows how high they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.integrity.height_error import CANDIDATES_M, MapHeightError, height_likelihood
from localizer.integrity.patch_covariance import height_correlation, patch_covariance
from localizer.registration.agreement import PatchDisplacements
from localizer.registration.priors import attitude_constraint, combine, fuse, height_constraint

HEIGHT_M, FOCAL_PX = 120.0, 110.0
DOWN = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, HEIGHT_M]))
BLOCKS_M = 25.0
NOTHING = np.zeros((6, 6))  # of the residuals


def patches() -> tuple[Array, Array]:
    """Motion (P, 2, 6) and ground (P, 2) of 10 x 7 patches below a camera that looks down."""
    x, y = np.meshgrid(np.linspace(-65, 65, 10), np.linspace(-45, 45, 7))
    ground = np.stack([x.ravel(), y.ravel()], axis=1)
    scale = FOCAL_PX / HEIGHT_M
    motion = np.zeros((len(ground), 2, 6))
    east, north = ground.T
    # u to the east, v to the south; a camera that moves east sees the ground move west.
    motion[:, 0, 0], motion[:, 1, 1] = -scale, scale
    motion[:, 0, 2], motion[:, 1, 2] = -scale * east / HEIGHT_M, scale * north / HEIGHT_M
    bend_x, bend_y = (HEIGHT_M**2 + side**2 for side in (east, north))
    across = scale * east * north / HEIGHT_M
    motion[:, 0, 3], motion[:, 1, 3] = -across, scale * bend_y / HEIGHT_M
    motion[:, 0, 4], motion[:, 1, 4] = scale * bend_x / HEIGHT_M, -across
    motion[:, 0, 5], motion[:, 1, 5] = scale * north, scale * east
    return motion, ground


def town(spread_m: float, seed: int, noise_px: float = 0.3) -> tuple[PatchDisplacements, Array]:
    """A registration over blocks whose heights the map does not have: its patches at the pose that
    explains them best, and by how much that pose is off (6,).
    """
    rng = np.random.default_rng(seed)
    motion, ground = patches()
    block = np.floor(ground / BLOCKS_M).astype(int)
    names, of = np.unique(block, axis=0, return_inverse=True)
    heights = np.abs(rng.normal(2.0 * spread_m, spread_m, len(names)))[of.ravel()]
    rise = -motion[:, :, 2]
    seen = rise * heights[:, None] + rng.normal(0.0, noise_px, (len(ground), 2))
    rows = motion.reshape(-1, 6)
    off = np.asarray(np.linalg.lstsq(rows, seen.reshape(-1), rcond=None)[0], np.float64)
    return PatchDisplacements(seen - motion @ off, motion, rise, ground), off


def registered(off: Array) -> Pose:
    return Pose(so3_exp(off[3:]) @ DOWN.rotation, DOWN.translation + off[:3])


def gravity(seed: int) -> object:
    rng = np.random.default_rng([seed, 1])
    sigma = np.radians(1.0)
    tilt = so3_exp(np.array([*rng.normal(0.0, sigma, 2), 0.0]))
    return combine(
        attitude_constraint(tilt @ DOWN.rotation, sigma, np.pi),
        height_constraint(HEIGHT_M + rng.normal(0.0, 3.0), 3.0),
    )


@pytest.mark.parametrize(("spread_m", "low", "high"), [(0.0, 0.0, 0.4), (5.0, 2.5, 10.0)])
def test_the_height_of_what_the_map_lacks_is_learned(spread_m, low, high):
    error = MapHeightError.prior(None)
    for seed in range(8):
        seen, off = town(spread_m, seed)
        likelihood = height_likelihood(seen, registered(off), gravity(seed))
        error = error.updated(likelihood)
    assert low <= error.sigma_m <= high


def test_errors_over_a_town_are_within_what_is_claimed():
    """Without the heights in the budget the pose is ten times better known than it is."""
    honest: list[float] = []
    naive: list[float] = []
    for seed in range(40):
        seen, off = town(5.0, seed)
        for values, sigma_m in ((honest, 5.0), (naive, 0.0)):
            covariance = patch_covariance(seen, sigma_m, NOTHING)
            assert covariance is not None
            values.append(off[:3] @ np.linalg.solve(covariance[:3, :3], off[:3]) / 3)
    assert np.mean(np.array(honest) < 2.6) > 0.9
    assert np.median(naive) > 5 * np.median(honest)


def test_gravity_and_height_undo_what_the_roofs_pulled():
    before, after, ratio = [], [], []
    for seed in range(40):
        seen, off = town(5.0, seed)
        found = fuse(registered(off), patch_covariance(seen, 5.0, NOTHING), gravity(seed))
        left = found.world_from_camera.translation - DOWN.translation
        before.append(np.linalg.norm(off[:3]))
        after.append(np.linalg.norm(left))
        ratio.append(left @ np.linalg.solve(found.covariance[:3, :3], left) / 3)
    assert np.median(after) < 0.5 * np.median(before)
    assert np.mean(np.array(ratio) < 2.6) > 0.9


def test_a_surface_model_is_taken_at_its_word_until_images_contradict():
    surface = MapHeightError.prior(0.0)
    assert surface.sigma_m == 0.0
    for seed in range(6):
        seen, off = town(5.0, seed)
        surface = surface.updated(height_likelihood(seen, registered(off), gravity(seed)))
    assert surface.sigma_m > 1.0


def test_the_likelihood_is_that_of_the_whole_covariance():
    """Of all displacements at once, the pose marginalised."""
    seen, off = town(2.5, 3)
    found = height_likelihood(seen, registered(off), None)
    y, rows, rise = seen.shift.reshape(-1), seen.motion.reshape(-1, 6), seen.rise.reshape(-1)
    raised = np.kron(height_correlation(seen.ground), np.ones((2, 2))) * np.outer(rise, rise)
    wanted = np.full(len(CANDIDATES_M), -np.inf)
    for k, spread_m in enumerate(CANDIDATES_M):
        for noise_px in (0.1, 0.2, 0.4, 0.8, 1.2, 1.8, 2.6):
            whole = noise_px**2 * np.eye(len(y)) + spread_m**2 * raised
            normal = rows.T @ np.linalg.solve(whole, rows)
            left = y - rows @ np.linalg.solve(normal, rows.T @ np.linalg.solve(whole, y))
            logs = np.linalg.slogdet(whole)[1] + np.linalg.slogdet(normal)[1]
            wanted[k] = max(wanted[k], -0.5 * (logs + left @ np.linalg.solve(whole, left)))
    assert found == pytest.approx(wanted - wanted.max(), abs=1e-3)


def test_too_few_patches_say_nothing():
    seen, off = town(5.0, 0)
    few = PatchDisplacements(seen.shift[:5], seen.motion[:5], seen.rise[:5], seen.ground[:5])
    assert height_likelihood(few, registered(off), None) is None
    assert patch_covariance(few, 5.0, NOTHING) is None


def test_a_pose_that_half_the_patches_hold_is_twice_as_uncertain():
    seen, _ = town(0.0, 0)
    whole, half = (patch_covariance(replace(seen, matched=f), 0.0, NOTHING) for f in (1.0, 0.5))
    assert whole is not None
    assert half == pytest.approx(4.0 * whole)
    assert patch_covariance(replace(seen, matched=0.0), 0.0, NOTHING) is None
    assert CANDIDATES_M[0] == 0.0


def test_patches_that_scatter_less_than_the_residuals_explain_add_nothing():
    seen, _ = town(0.0, 0)
    by_residuals = np.diag([4.0, 9.0, 1.0, 1e-3, 2e-3, 1e-3])
    found = patch_covariance(seen, 0.0, by_residuals)
    assert found == pytest.approx(0.5 * by_residuals)


@pytest.mark.parametrize("badly", range(6))
def test_one_direction_that_residuals_hold_badly_leaves_the_patches_noise_in_the_others(badly):
    seen, _ = town(0.0, 0)
    alone = patch_covariance(seen, 0.0, NOTHING)
    assert alone is not None
    by_residuals = 0.01 * np.diag(np.diag(alone))
    by_residuals[badly, badly] *= 1e6
    found = patch_covariance(seen, 0.0, by_residuals)
    assert found is not None
    unit = 1.0 / np.sqrt(np.diag(found))
    for least in (alone, 0.5 * by_residuals):
        beyond = np.linalg.eigvalsh((found - least) * np.outer(unit, unit))
        assert beyond[0] == pytest.approx(0.0, abs=1e-6)  # no less in any direction, no more in one
