"""A generated world as a satellite map shows it: ground in place, roofs leaning, no buildings."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.inspection.kind import object_mask
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import TopView, render_top_view
from sitl.demo.assets import build_satellite_map
from sitl.demo.scenario import SatelliteMap

GSD_M, SIDE_PX, REACH_PX = 0.5, 640, 40


def seen_from_above(path) -> TopView:
    cache = TileCache.open(path)
    with TileStreamer(cache) as streamer:
        renderer = NumbaRenderer(streamer, 1)
        try:
            base_m = float(cache.index.box_min[0, 2])
            return render_top_view(renderer, np.zeros(2), SIDE_PX, GSD_M, base_m)
        finally:
            renderer.close()


def offset_m(survey: TopView, satellite: TopView, row: int, column: int, half: int) -> np.ndarray:
    """East and north, by which a patch of the survey lies elsewhere in the satellite's mosaic."""
    patch = survey.rgb[row - half : row + half, column - half : column + half]
    reach = half + REACH_PX
    area = satellite.rgb[row - reach : row + reach, column - reach : column + reach]
    score = cv2.matchTemplate(area, patch, cv2.TM_CCOEFF_NORMED)
    found = np.array(np.unravel_index(score.argmax(), score.shape)) - REACH_PX
    return np.array([found[1], -found[0]]) * GSD_M


def test_ground_stays_and_roofs_lean_away_from_the_satellite(small_assets, tmp_path, monkeypatch):
    monkeypatch.setattr("sitl.demo.assets.BuildOptions", partial(BuildOptions, workers=1))
    off_nadir_deg, azimuth_deg = 18.0, 240.0
    spec = SatelliteMap(off_nadir_deg=off_nadir_deg, azimuth_deg=azimuth_deg, blur_px=0.8)
    build_satellite_map(small_assets.world, small_assets.map_cache, spec, tmp_path / "map")
    kind = TileCache.open(tmp_path / "map").manifest.kind
    assert kind.heights == "terrain"

    survey, mosaic = seen_from_above(small_assets.map_cache), seen_from_above(tmp_path / "map")
    above_m = survey.height - mosaic.height
    built = object_mask(survey.height, GSD_M)
    margin = REACH_PX + 60
    inner = np.zeros_like(built)
    inner[margin:-margin, margin:-margin] = True
    assert np.median(np.abs(above_m[~built & inner])) < 0.1

    away = -np.array([np.sin(np.radians(azimuth_deg)), np.cos(np.radians(azimuth_deg))])
    roofs = cv2.erode((built & inner & (above_m > 6.0)).astype(np.uint8), np.ones((17, 17)))
    places = np.argwhere(roofs)
    assert len(places)
    errors = []
    for row, column in places[:: max(len(places) // 20, 1)]:
        expected = above_m[row, column] * np.tan(np.radians(off_nadir_deg)) * away
        errors.append(np.hypot(*(offset_m(survey, mosaic, row, column, 12) - expected)))
    assert np.median(errors) < 1.5 * GSD_M

    open_ground = cv2.erode((~built & inner).astype(np.uint8), np.ones((33, 33)))
    places = np.argwhere(open_ground)
    still = [
        np.hypot(*offset_m(survey, mosaic, row, column, 16))
        for row, column in places[:: max(len(places) // 20, 1)]
    ]
    assert np.median(still) < 1.5 * GSD_M
