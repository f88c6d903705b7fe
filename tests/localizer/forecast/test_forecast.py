"""The forecast tells textured ground from plain ground, and the map's edge, before any flight."""

import cv2
import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.forecast.forecast import (
    FORECAST_CONDITIONS,
    RISK_LIMIT,
    Figures,
    Forecaster,
    draw_prior,
    failure_risk,
    simulate_visit,
)
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.tile import TileMesh
from localizer.registration.jngo import JNGO
from localizer.render.base import StaticTiles
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import DOWN

CAMERA = Camera.from_fov(320, 240, 60.0)
HALF_M = 150.0


def rendered(texture: np.ndarray) -> NumbaRenderer:
    """A flat square of 300 m under a texture."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32) * HALF_M
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return NumbaRenderer(StaticTiles([TileMesh(corners, uvs, faces, (texture,), Pose.identity())]))


def town() -> np.ndarray:
    """Roofs and streets: grey and red rectangles on soil, none like another."""
    rng = np.random.default_rng(3)
    image = np.full((1024, 1024, 3), (120, 110, 90), np.uint8)
    for _ in range(700):
        x, y = rng.integers(0, 1000, 2)
        w, h = rng.integers(8, 45, 2)
        colour = rng.integers(40, 230) * np.array([1.0, *rng.uniform(0.6, 1.0, 2)])
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), colour.tolist(), -1)
    return image


@pytest.fixture(scope="module")
def forecast():
    """Forecasts by day, straight down from 100 m over a place, on a texture."""
    extractor, optimizer = DetailExtractor(load_extractor(None, threads=1)), JNGO(threads=1)

    def at(texture, east=0.0, condition="day", seed=1):
        forecaster = Forecaster(
            rendered(texture), extractor, optimizer, CAMERA, LocalizerConfig(), draws=1
        )
        pose = Pose(DOWN, np.array([east, 0.0, 100.0]))
        return forecaster.at(pose, (condition,), seed)[0]

    return at


def test_a_town_holds_and_bare_ground_does_not(forecast):
    good = forecast(town())
    assert good.risk < RISK_LIMIT
    assert good.figures.failed == 0
    assert 0.01 < good.sigma_m < 1.0
    assert good.ground_m == pytest.approx(100, abs=0.1)
    bare = forecast(np.full((1024, 1024, 3), (120, 110, 90), np.uint8))
    assert bare.risk > 2 * RISK_LIMIT
    assert bare.texture < good.texture


def test_the_same_question_has_the_same_answer_and_another_seed_another(forecast):
    assert forecast(town(), seed=4) == forecast(town(), seed=4)
    assert forecast(town(), seed=4) != forecast(town(), seed=5)


def test_beside_the_map_there_is_nothing(forecast):
    beside = forecast(town(), east=400.0)
    assert (beside.risk, beside.ground_m) == (1.0, 0.0)
    edge, middle = forecast(town(), east=HALF_M), forecast(town())
    assert edge.figures.map_share == pytest.approx(0.5, abs=0.02)
    assert edge.sigma_m > middle.sigma_m


def test_a_lattice_looks_like_itself_one_step_on_and_a_town_does_not(forecast):
    lattice = np.tile(town()[:128, :128], (8, 8, 1))
    assert forecast(lattice).rival.share > forecast(town()).rival.share + 0.2


@pytest.mark.parametrize("condition", FORECAST_CONDITIONS)
def test_every_condition_changes_the_picture_and_nothing_else(condition):
    view = rendered(town()).render(Pose(DOWN, np.array([0.0, 0.0, 100.0])), CAMERA)
    before = view.rgb.copy()
    drawn = simulate_visit(view, condition, np.random.default_rng(1))
    assert drawn.shape == view.rgb.shape
    assert drawn.dtype == np.uint8
    assert np.array_equal(view.rgb, before)
    assert np.abs(drawn.astype(int) - before).mean() > 4


def test_an_unknown_condition_is_named():
    view = rendered(town()).render(Pose(DOWN, np.array([0.0, 0.0, 100.0])), CAMERA)
    with pytest.raises(ValueError, match="'hail' is not one of day"):
        simulate_visit(view, "hail", np.random.default_rng(1))


def test_more_error_or_less_agreement_is_more_risk():
    good = Figures(0.2, 0.95, 0.7, 1.0, 0.0, 0.2)
    assert failure_risk(Figures(0.2, 0.95, 0.7, 1.0, 1.0, 3.0)) > failure_risk(good)
    assert failure_risk(Figures(0.2, 0.3, 0.2, 1.0, 0.0, 0.2)) > failure_risk(good)
    assert failure_risk(Figures(10.0, 0.0, 0.0, 0.1, 1.0, 10.0)) > 0.9


def test_priors_err_as_they_say():
    truth = Pose(DOWN, np.zeros(3))
    rng = np.random.default_rng(2)
    drawn = [draw_prior(truth, rng) for _ in range(400)]
    offsets = np.array([p.world_from_camera.translation for p in drawn])
    sigma = np.sqrt(drawn[0].covariance.diagonal()[:3])
    assert offsets.std(axis=0) == pytest.approx(sigma, rel=0.15)
