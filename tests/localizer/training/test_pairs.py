from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from localizer.errors import SequenceError
from localizer.geometry.pose import Pose
from localizer.synth.heightfield.render import render
from localizer.training.data.pairs import (
    Pair,
    SceneConfig,
    draw_place,
    draw_views,
    scene_pairs,
    survey_scene,
)
from localizer.training.data.shards import read_shard, write_shard, write_shards
from localizer.training.places.land import PhotoLibrary
from localizer.types import Float32

SMALL = SceneConfig(cells=256, width=128, height=96, references=3, queries_per_light=3)


def warp_check(pair: Pair) -> tuple[Float32, NDArray[np.bool_]]:
    """The query's colours brought into the reference view by depth and poses (paper, Fig. 14).

    Returns the warped image (H, W, 3) float32 in 0..255 and the mask (H, W) of what both views see.
    """
    camera = pair.camera
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = camera.rays(np.stack([u, v], -1))
    points = pair.world_from_reference.apply(rays * pair.reference_depth[..., None])
    local = pair.world_from_query.inverse.apply(points)
    pixels, inside = camera.project(local)
    pixels = np.nan_to_num(pixels, nan=-1.0).astype(np.float32) - np.float32(0.5)
    x, y = pixels[..., 0], pixels[..., 1]
    warped = cv2.remap(pair.query.astype(np.float32), x, y, cv2.INTER_LINEAR)
    depth = cv2.remap(pair.query_depth, x, y, cv2.INTER_NEAREST)
    z = local[..., 2]
    same = np.abs(depth - z) < 0.02 * z + 1.0
    return warped, inside & same & (pair.reference_depth > 0)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return [p for seed in (1000, 1001, 1002) for p in scene_pairs(seed, SMALL, None)]


def likeness(pair: Pair) -> float:
    """Correlation of local structure between reference and warped query where both see."""
    warped, mask = warp_check(pair)
    a = pair.reference.astype(np.float32).mean(-1)
    b = warped.mean(-1)
    return float(np.corrcoef(a[mask], b[mask])[0, 1])


def test_depth_and_poses_bring_the_query_into_the_reference() -> None:
    # Both views show the survey: what is left is geometry (paper, Fig. 14).
    for seed in (1003, 1004):
        rng = np.random.default_rng(seed)
        place, source = draw_place(rng, SMALL, None)
        survey = survey_scene(rng, place, SMALL)
        views = draw_views(rng, survey, survey, SMALL)
        assert views is not None
        reference, query, camera = views
        (image, depth), (seen, seen_depth) = (render(survey, p, camera) for p in (reference, query))
        pair = Pair(image, depth, seen, seen_depth, reference, query, camera, "day", False, source)
        shift = 0.04 * float(np.median(seen_depth))
        wrong = replace(pair, world_from_query=Pose(query.rotation, query.translation + shift))
        assert likeness(pair) > 0.4
        assert likeness(wrong) < likeness(pair) - 0.1


def test_views_overlap_and_motion_is_the_papers(pairs: list[Pair]) -> None:
    assert len(pairs) >= 7
    for pair in pairs:
        metres, degrees = pair.world_from_reference.distance_to(pair.world_from_query)
        assert metres <= 15.0
        assert degrees <= 15.0 + 1e-6
        assert warp_check(pair)[1].mean() > 0.25
        # The camera looks 20 to 90 degrees down.
        assert np.degrees(np.arcsin(-pair.world_from_reference.rotation[2, 2])) > 19.0


def test_the_coarse_map_is_where_the_true_surface_is() -> None:
    # Off the depth edges, the map's rounded and bumpy mesh stays within its stated error.
    pair = next(iter(scene_pairs(1006, replace(SMALL, motion=(0.0, 0.0)), None)))
    error = np.abs(pair.reference_depth - pair.query_depth)[pair.reference_depth > 0]
    assert 0.0 < np.median(error) < 1.5


def test_shards_keep_what_was_generated(pairs: list[Pair], tmp_path: Path) -> None:
    stored = read_shard(write_shard(tmp_path, 1000, SMALL, None))[0]
    np.testing.assert_array_equal(stored.reference, pairs[0].reference)
    np.testing.assert_allclose(stored.reference_depth, pairs[0].reference_depth, rtol=1e-3)
    assert stored.camera == pairs[0].camera
    assert stored.world_from_query.distance_to(pairs[0].world_from_query) == (0.0, 0.0)


def test_shards_on_disk_are_not_made_again(tmp_path: Path) -> None:
    made = list(write_shards(tmp_path, range(1000, 1002), SMALL, None, workers=2))
    assert [p.stem for p in made] == ["00001000", "00001001"]
    assert list(write_shards(tmp_path, range(1000, 1002), SMALL, None, workers=2)) == []


def test_cross_season_plots_are_split_between_training_and_test(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(8):
        plot = tmp_path / "neon_sjer_pairs" / f"SJER_{k:03d}"
        plot.mkdir(parents=True)
        for date in ("2017", "2018"):
            cv2.imwrite(str(plot / f"{date}.jpg"), np.full((16, 16, 3), 30 * k, np.uint8))
    seen: dict[bool, set[int]] = {}
    for held_out in (False, True):
        library = PhotoLibrary(tmp_path, ("neon_sjer_pairs",), held_out=held_out)
        layers = [library.sample(rng, 48) for _ in range(6)]
        assert all(len(dates) == 2 for dates in layers)
        found = np.concatenate([np.unique(dates[0]) for dates in layers])
        seen[held_out] = set(np.rint(found / 30).astype(int).tolist())
    assert seen[True] == {3, 7}
    assert seen[False] == {0, 1, 2, 4, 5, 6}


def test_a_missing_texture_group_is_named(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="moon"):
        PhotoLibrary(tmp_path, ("moon",))
