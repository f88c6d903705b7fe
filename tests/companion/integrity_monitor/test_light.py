"""Falling light: the limit of the alert is reached before registrations are refused."""

from __future__ import annotations

import numpy as np

from companion.integrity_monitor.video import LOW_DETAIL, detail, thumbnail
from companion.recorded.sequence import load_sequence
from localizer.config import LocalizerConfig
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.tracking.opening import open_localizer
from localizer.types import Frame, PosePrior
from sitl.camera.faults import darken

LIMIT = LOW_DETAIL


def test_it_is_told_while_registrations_are_still_accepted(small_assets, small_sequence):
    sequence = load_sequence(small_sequence, TileCache.open(small_assets.map_cache).frame)
    frame, truth = sequence.frame(0), sequence.truth[0]
    beside = Pose(truth.rotation, truth.translation + np.array([2.0, -2.0, 1.0]))
    sigma = np.diag([2.0, 2.0, 2.0, 0.02, 0.02, 0.02]) ** 2
    config = LocalizerConfig(renderer="numba")
    seen: list[tuple[float, bool]] = []
    with open_localizer(small_assets.map_cache, frame.camera, config) as localizer:
        for k in range(0, 20, 2):
            rng = np.random.default_rng(k)
            image = darken(frame.image, 0.5**k, 16.0, rng) if k else frame.image
            at_ns = (k + 1) * 10**9
            localizer.set_prior(PosePrior(beside, sigma, at_ns))
            estimate = localizer.track(Frame(image, at_ns, frame.camera, k), passes=2)
            seen.append((detail(thumbnail(image)), estimate.accepted))
    assert seen[0][0] > 2.0 * LIMIT
    assert [accepted for figure, accepted in seen if figure >= LIMIT].count(False) == 0
    assert next(accepted for figure, accepted in seen if figure < LIMIT)  # told, and yet accepted
    assert not seen[-1][1]
