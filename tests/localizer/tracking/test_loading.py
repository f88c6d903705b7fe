"""A view of which nothing is in memory yet is no view off the map."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.errors import MapLoadingError, OutsideMapError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.tracking.engine_health import HealthCounters
from localizer.tracking.pipeline import Localizer
from localizer.types import PosePrior


def test_a_map_that_is_being_loaded_is_told_as_that() -> None:
    """Each start warned that the view does not meet the map."""
    camera = Camera.from_fov(320, 240, 60)
    empty: Any = SimpleNamespace(depth=np.zeros((240, 320), np.float32))
    renderer: Any = SimpleNamespace(render=lambda *_, **__: empty)
    optimizer: Any = SimpleNamespace(on_gpu=True)
    loading = [True]
    localizer = Localizer(
        renderer, None, optimizer, camera, LocalizerConfig(odometry=None),  # type: ignore[arg-type]
        is_loading=lambda: loading[0],
    )  # fmt: skip
    prior = PosePrior.around(Pose.identity())
    with pytest.raises(MapLoadingError, match="is being loaded"):
        localizer.make_reference(prior)
    loading[0] = False
    with pytest.raises(OutsideMapError, match="does not meet the map"):
        localizer.make_reference(prior)


def test_an_engine_says_that_the_map_is_loading():
    book = HealthCounters("", "")
    book.report(MapLoadingError("the map is being loaded"))
    assert book.read(0, "").map_loading
    book.report(OutsideMapError("the view does not meet the map"))
    assert not book.read(0, "").map_loading
