"""The whole registration on the device against the same registration by the CPU's backend."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localizer.device_array import DeviceArray
from localizer.errors import DeviceArrayError
from localizer.geometry.pose import so3_exp
from localizer.registration.anchors import select_anchors
from localizer.registration.config import JNGOConfig
from localizer.registration.jngo import JNGO
from localizer.registration.priors import attitude_constraint, combine, height_constraint
from localizer.types import FeatureLevel, FeaturePyramid, PosePrior, RegistrationStatus

CONFIG = JNGOConfig(hypotheses=16, survivors=(6, 3), swarm_anchors=(100, 150, 150))


@pytest.fixture
def registered(make_backend):
    """``registered(config)``: `JNGO.register` on the device."""
    return lambda config=CONFIG: JNGO(config, make_backend()).register


def check(device, cpu, metres=3e-3, degrees=3e-3, rtol=0.02):
    """Both sum in float32, so a last step of a millimetre, whose gain is in the scores' seventh
    digit, may be taken by one and refused by the other, and two hypotheses at the limit of being
    distinct may be one or two. Step by step, with equal counts and 1 mm: test_refine.py.
    """
    assert device.status is cpu.status
    distance, angle = device.world_from_camera.distance_to(cpu.world_from_camera)
    assert distance < metres
    assert angle < degrees
    sigma = np.sqrt(np.diag(cpu.covariance))
    np.testing.assert_allclose(
        device.covariance / np.outer(sigma, sigma),
        cpu.covariance / np.outer(sigma, sigma),
        atol=rtol,
    )
    assert device.score == pytest.approx(cpu.score, rel=1e-3)
    assert device.overlap == pytest.approx(cpu.overlap, abs=1 / 100)
    assert device.quality == pytest.approx(cpu.quality, abs=1e-3)
    assert device.evaluations == pytest.approx(cpu.evaluations, rel=0.2)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"iterations": (3, 1, 2)},
        {"sharpen": 0},
        {"hypotheses": 1, "survivors": (1, 1)},
        {"survivors": (16, 16), "duplicate_px": 0.02},
        {"swarm_anchors": (40, 1000, 70)},
    ],
    ids=str,
)
def test_agrees_with_the_cpu(registered, scene, prior, changes):
    config = replace(CONFIG, **changes)
    arguments = (scene.query, scene.camera, scene.anchors, prior(scene.reference, 1.0, 1.5))
    check(registered(config)(*arguments), JNGO(config).register(*arguments))


def test_agrees_with_a_prediction_and_a_constraint(registered, scene, prior):
    about = prior(scene.reference, 1.0, 1.5)
    moved = replace(scene.true, translation=scene.true.translation + np.array([1.0, 0.5, -0.5]))
    motion = PosePrior(moved, np.diag([0.5] * 3 + [1e-4] * 3), 0)
    turned = so3_exp([0.0, 0.0, 0.02]) @ scene.true.rotation
    known = combine(
        attitude_constraint(turned, 0.01, 0.05),
        height_constraint(scene.true.translation[2] + 0.3, 0.2),
    )
    arguments = (scene.query, scene.camera, scene.anchors, about)
    device, cpu = registered(), JNGO(CONFIG)
    plain = cpu.register(*arguments)
    for extra in ({"motion": motion}, {"constraint": known},
                  {"motion": motion, "constraint": known}):  # fmt: skip
        expected = cpu.register(*arguments, **extra)
        check(device(*arguments, **extra), expected)
        assert expected.world_from_camera.distance_to(plain.world_from_camera)[0] > 1e-4 or (
            "constraint" not in extra
        )


def test_the_prediction_does_not_prune(registered, scene, prior):
    """One survivor a level, and a prediction that would rather keep a hypothesis that is worse."""
    config = replace(CONFIG, survivors=(1, 1), motion_weight=100.0)
    about = prior(scene.reference, 1.0, 3.0)
    arguments = (scene.query, scene.camera, scene.anchors, about)
    far = replace(scene.true, rotation=so3_exp([0.0, 0.1, 0.0]) @ scene.true.rotation)
    motion = PosePrior(far, np.diag([0.5] * 3 + [1e-4] * 3), 0)
    found, plain = registered(config)(*arguments, motion=motion), registered(config)(*arguments)
    check(found, JNGO(config).register(*arguments, motion=motion))
    np.testing.assert_array_equal(found.world_from_camera.matrix, plain.world_from_camera.matrix)


def with_detail(pyramid, channels=4):
    """One more level of stride 1, with fewer channels, as `DetailExtractor` appends."""
    last = pyramid.levels[-1]
    features = np.kron(last.features[..., :channels], np.ones((2, 2, 1), np.float32))
    smooth = np.ascontiguousarray(
        sum(np.roll(features, shift, axis) for shift in (0, 1) for axis in (0, 1)) / 4
    )
    confidence = np.kron(last.confidence, np.ones((2, 2), np.float32))
    return replace(pyramid, levels=(*pyramid.levels, FeatureLevel(smooth, confidence, 1)))


@pytest.mark.parametrize("constrained", [False, True])
def test_agrees_on_a_detail_level(registered, place, scene, prior, constrained):
    reference = with_detail(place.pyramid(scene.reference, scene.camera, 0.05, 11))
    anchors = select_anchors(place.view(scene.reference, scene.camera), reference, 300, 11)
    arguments = (with_detail(scene.query), scene.camera, anchors, prior(scene.reference, 1.0, 1.5))
    known = height_constraint(scene.true.translation[2] + 0.3, 0.2) if constrained else None
    expected = JNGO(CONFIG).register(*arguments, constraint=known)
    check(registered()(*arguments, constraint=known), expected)


def failed(result, about, status):
    assert result.status is status
    assert result.world_from_camera is about.world_from_camera
    assert np.isinf(result.score)


def test_behind_the_camera_there_is_no_overlap(registered, scene, prior):
    back = replace(scene.true, rotation=scene.true.rotation @ np.diag([1.0, -1.0, -1.0]))
    about = prior(back, 1.0, 1.0)
    result = registered()(scene.query, scene.camera, scene.anchors, about)
    failed(result, about, RegistrationStatus.NO_OVERLAP)


def changed(query: FeaturePyramid, level: int, **changes) -> FeaturePyramid:
    levels = list(query.levels)
    levels[level] = replace(levels[level], **changes)
    return replace(query, levels=tuple(levels))


@pytest.mark.filterwarnings("ignore:invalid value encountered in matmul")  # of the infinite point
@pytest.mark.parametrize("kind", ["features", "confidence", "anchors", "points"])
def test_one_value_that_is_not_finite_is_seen(registered, scene, prior, kind):
    about, query, anchors = prior(scene.reference, 1.0, 1.0), scene.query, scene.anchors
    if kind in ("features", "confidence"):
        values = getattr(query.levels[2], kind).copy()
        values.reshape(-1)[-1] = np.nan
        query = changed(query, 2, **{kind: values})
    elif kind == "anchors":
        values = anchors.features[0].copy()
        values[-1, -1] = np.inf
        anchors = replace(anchors, features=(values, *anchors.features[1:]))
    else:
        points = anchors.points_world.copy()
        points[7, 2] = np.inf
        anchors = replace(anchors, points_world=points)
    result = registered()(query, scene.camera, anchors, about)
    failed(result, about, RegistrationStatus.BAD_FEATURES)


def test_flat_features_have_no_texture(registered, scene, prior):
    about, query, anchors = prior(scene.reference, 1.0, 1.0), scene.query, scene.anchors
    for k in range(3):
        flat = np.full_like(query.levels[k].features, 0.25)
        query = changed(query, k, features=flat)
    anchors = replace(anchors, features=tuple(np.full_like(f, 0.25) for f in anchors.features))
    result = registered()(query, scene.camera, anchors, about)
    failed(result, about, RegistrationStatus.NO_TEXTURE)


def test_frames_of_other_sizes_and_a_failure_between_leave_no_trace(registered, scene, prior):
    about = prior(scene.reference, 1.0, 1.5)
    register = registered()
    arguments = (scene.query, scene.camera, scene.anchors, about)
    first = register(*arguments)
    half = replace(
        scene.anchors,
        points_world=scene.anchors.points_world[::2],
        pixels=scene.anchors.pixels[::2],
        features=tuple(f[::2] for f in scene.anchors.features),
        confidence=tuple(c[::2] for c in scene.anchors.confidence),
    )
    fewer = register(scene.query, scene.camera, half, about)
    assert fewer.status is RegistrationStatus.OK
    back = replace(scene.true, rotation=scene.true.rotation @ np.diag([1.0, -1.0, -1.0]))
    register(scene.query, scene.camera, scene.anchors, prior(back, 1.0, 1.0))
    again = register(*arguments)
    np.testing.assert_array_equal(first.world_from_camera.matrix, again.world_from_camera.matrix)
    np.testing.assert_array_equal(first.covariance, again.covariance)


def test_one_graph_serves_every_frame_and_little_comes_back(emulator, registered, scene, prior):
    register = registered()
    arguments = (scene.query, scene.camera, scene.anchors, prior(scene.reference, 1.0, 1.5))
    register(*arguments)
    before = emulator.counts()
    register(*arguments)
    after = emulator.counts()
    assert after.graphs - before.graphs == 1
    assert after.allocations == before.allocations
    assert after.to_host - before.to_host < 2048


def test_features_on_the_device_are_used_in_place(emulator, registered, scene, prior):
    register = registered()
    about = prior(scene.reference, 1.0, 1.5)
    expected = register(scene.query, scene.camera, scene.anchors, about)
    query, held = scene.query, []
    for k, level in enumerate(query.levels):
        arrays = {}
        for name in ("features", "confidence"):
            values = getattr(level, name)
            address = emulator.device.allocate(values.nbytes)
            emulator.device.upload(address, values)
            held.append(address)
            arrays[name] = DeviceArray(address, values.shape, values.dtype)
        query = changed(query, k, **arrays)
    before = emulator.counts().to_device
    found = register(query, scene.camera, scene.anchors, about)
    sent = emulator.counts().to_device - before
    np.testing.assert_array_equal(found.world_from_camera.matrix, expected.world_from_camera.matrix)
    assert sent < scene.query.levels[-1].features.nbytes
    half = changed(query, 0, features=replace(query.levels[0].features, dtype=np.dtype(np.float16)))
    with pytest.raises(DeviceArrayError, match="float16"):
        register(half, scene.camera, scene.anchors, about)
    for address in held:
        emulator.device.free(address)


def test_no_barrier_is_missing(emulator, registered, scene, prior):
    """The bits do not depend on the order in which the threads run between barriers."""
    register = registered(replace(CONFIG, hypotheses=6, survivors=(3, 2)))
    arguments = (scene.query, scene.camera, scene.anchors, prior(scene.reference, 1.0, 1.5))
    expected = register(*arguments)
    for order in (1, 5):
        emulator.order(order)
        found = register(*arguments)
        np.testing.assert_array_equal(
            found.world_from_camera.matrix, expected.world_from_camera.matrix
        )
        np.testing.assert_array_equal(found.covariance, expected.covariance)
        assert found.quality == expected.quality
