"""Another focal length: found out where it fits better, no alarm where the own one is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localizer.integrity.acceptance import IntegrityConfig, is_acceptable
from localizer.registration.anchors import select_anchors
from localizer.registration.jngo import JNGO
from localizer.registration.zoom import focal_gain
from localizer.tracking.pipeline import mask_unseen_features
from localizer.types import RegistrationStatus
from tests.localizer.registration.conftest import SyntheticPlace, camera_pose, perturbed

CONFIG = IntegrityConfig()


@pytest.fixture(scope="module")
def jngo():
    return JNGO(threads=1)


def believed(scene, factor):
    """The scene's camera as a wrong calibration has it."""
    camera = scene.camera
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_a_focal_length_that_is_off_is_found_out(jngo, scene_factory, prior, factor):
    """The place seems 5 % too near or far, with a good quality and nearly all parts' votes. Flat
    ground seen straight down does not tell: one scene of six.
    """
    let_in = refused = 0
    for seed in range(3):
        scene = scene_factory(seed, 2.0, 2.0)
        camera, begun = believed(scene, factor), prior(scene.reference, 4.0, 5.0)
        found = jngo.register(scene.query, camera, scene.anchors, begun)
        let_in += is_acceptable(CONFIG, found, 0.0)
        assert found.world_from_camera.distance_to(scene.true)[0] > 3.0
        tested = jngo.with_focal_gain(scene.query, camera, scene.anchors, found)
        refused += not is_acceptable(CONFIG, tested, 0.0)
    assert let_in == 3
    assert refused >= 2


@pytest.mark.parametrize("factor", [1.0, 0.99, 1.01])
def test_a_calibration_as_good_as_one_is_raises_no_alarm(jngo, scene_factory, prior, factor):
    for seed in range(4):
        scene = scene_factory(seed, 2.0, 2.0)
        camera, begun = believed(scene, factor), prior(scene.reference, 4.0, 5.0)
        found = jngo.register(scene.query, camera, scene.anchors, begun)
        tested = jngo.with_focal_gain(scene.query, camera, scene.anchors, found)
        assert np.isfinite(tested.focal_gain)
        assert is_acceptable(CONFIG, tested, 0.0)


def test_a_perfect_fit_raises_no_alarm(jngo, scene_factory, prior):
    """A right place in fog, 1 cm off, was once refused: its cost was below the unit of the priors'
    weight, which stood in for it, and another focal length's, 8 % higher, was below that, too.
    """
    assert focal_gain({0.95: 9.22e-4, 1.0: 8.52e-4, 1.05: 9.27e-4}) < -0.05
    scene = scene_factory(2, 2.0, 2.0)
    exact = scene.place.pyramid(scene.true, scene.camera)
    reference = scene.place.pyramid(scene.reference, scene.camera)
    anchors = select_anchors(scene.place.view(scene.reference, scene.camera), reference, 300, 0)
    found = jngo.register(exact, scene.camera, anchors, prior(scene.reference, 4.0, 5.0))
    tested = jngo.with_focal_gain(exact, scene.camera, anchors, found)
    assert found.world_from_camera.distance_to(scene.true)[0] < 0.1
    assert tested.focal_gain < -0.1
    assert is_acceptable(CONFIG, tested, 0.0)


def test_what_failed_is_not_tested(jngo, scene_factory, prior):
    scene = scene_factory(0, 2.0, 2.0)
    found = jngo.register(scene.query, scene.camera, scene.anchors, prior(scene.reference, 4, 5))
    failed = replace(found, status=RegistrationStatus.NO_OVERLAP)
    assert (
        jngo.with_focal_gain(scene.query, scene.camera, scene.anchors, failed).focal_gain == -np.inf
    )


def test_the_focal_length_is_found_beside_the_pose(jngo, scene_factory, prior):
    """To 0.3 % by a handful of pictures."""
    factor = 1.015
    fits = []
    for seed in (0, 2, 4):
        scene = scene_factory(seed, 2.0, 2.0)
        camera, begun = believed(scene, 1.0 / factor), prior(scene.reference, 4.0, 5.0)
        found = jngo.register(scene.query, camera, scene.anchors, begun)
        fits.append(jngo.fit_focal(scene.query, camera, scene.anchors, found))
    told = [fit for fit in fits if fit is not None]
    assert len(told) == 3
    assert all(abs(fit.factor - factor) < 4.0 * fit.sigma for fit in told)
    weights = [fit.sigma**-2 for fit in told]
    mean = sum(w * fit.factor for w, fit in zip(weights, told, strict=True)) / sum(weights)
    assert mean == pytest.approx(factor, abs=0.003)


def test_flat_ground_below_tells_no_focal_length(jngo, camera, prior):
    place = SyntheticPlace.from_seed(3, relief_m=0.0)
    pose = camera_pose(np.array([0.0, 0.0, 110.0]), 90.0, 30.0)
    reference = perturbed(pose, 2.0, 1.0, 0)
    pyramid = place.pyramid(reference, camera, 0.05, 0)
    anchors = select_anchors(place.view(reference, camera), pyramid, 300, 0)
    query = place.pyramid(pose, camera, 0.05, 1)
    found = jngo.register(query, camera, anchors, prior(reference, 4.0, 5.0))
    assert found.status is RegistrationStatus.OK
    assert jngo.fit_focal(query, camera, anchors, found) is None


def test_what_a_longer_lens_does_not_show_has_no_vote(jngo, scene_factory, prior):
    """At twice the focal length three quarters of the picture are black. They met the map's anchors
    and pulled the pose metres away: 5.3 m off here, quality 0.23.
    """
    scene = scene_factory(1, 2.0, 2.0)
    rows, columns = np.mgrid[: scene.camera.height, : scene.camera.width]
    seen = (abs(columns - 80) < 40) & (abs(rows - 60) < 30)
    levels = []
    for level in scene.query.levels:
        h, w = level.confidence.shape
        shown = seen[:: level.stride, :: level.stride][:h, :w, None]
        black = np.where(shown, level.features, level.features[0, 0]).astype(np.float32)
        levels.append(replace(level, features=black))
    black = replace(scene.query, levels=tuple(levels))
    begun = prior(scene.reference, 4.0, 5.0)
    raw = jngo.register(black, scene.camera, scene.anchors, begun)
    found = jngo.register(mask_unseen_features(black, seen), scene.camera, scene.anchors, begun)
    assert (raw.quality < 0.3, found.quality > 0.9) == (True, True)
    assert found.agreement.patches < raw.agreement.patches
    assert found.agreement.share > 0.9
    off = [r.world_from_camera.distance_to(scene.true)[0] for r in (raw, found)]
    assert off[1] < 0.6 * off[0]
