"""A view of which nothing is in memory yet is no view off the map."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.errors import MapCacheError, MapLoadingError, OutsideMapError
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


@pytest.mark.parametrize("error", [MapLoadingError, OutsideMapError])
def test_a_view_without_map_is_no_failure_and_any_other_error_is(error):
    """On the ground the near surfaces are cut off; the ground station was advised to land."""
    book = HealthCounters("", "")
    book.report(error("nothing in view"))
    assert book.read(0, "").no_map_in_view
    book.report(MapCacheError("gone"))
    assert not book.read(0, "").no_map_in_view


def test_another_kind_of_error_is_logged_at_once(caplog):
    """The log that an alert referred to had the error of 3 s before only."""
    book = HealthCounters("", "")
    for error in (MapLoadingError("loading"), MapLoadingError("still"), MapCacheError("gone")):
        book.report(error)
    assert [r.message for r in caplog.records] == ["loading", "gone"]
