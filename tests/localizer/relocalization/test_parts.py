"""The search's parts, each against what it should be by definition."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import scipy.fft

from localizer.errors import MapCacheError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.integrity.acceptance import IntegrityConfig
from localizer.registration.agreement import PatchAgreement
from localizer.registration.result import Registration
from localizer.relocalization.align import FrameShift, displacement
from localizer.relocalization.config import RelocalizationConfig
from localizer.relocalization.correlate import (
    ORIGIN_CELLS,
    ROUGH_CELLS,
    LevelCorrelator,
    transform_patch,
)
from localizer.relocalization.overview import FeatureFile, OverviewLevel, Projection
from localizer.relocalization.patch import CameraFootprint, footprint, rectify, with_heading
from localizer.relocalization.search import (
    Rectification,
    SearchView,
    above_roofs,
    fitted,
    ground_of,
    peaks,
    search,
    trial_heights,
    trial_noise,
)
from localizer.relocalization.strip import GroundStrip
from localizer.relocalization.types import PlaceCandidate, PlaceQuery, SearchRegion
from localizer.relocalization.verify import Verifier
from localizer.render.topview import DOWN
from localizer.tracking.sensor_fusion import FusedRegistration
from localizer.types import FeatureLevel, FeaturePyramid, Frame, RegistrationStatus

CAMERA = Camera.from_fov(160, 120, 60.0)
CONFIG = RelocalizationConfig()


def query(heading_sigma_rad=None, height_m=100.0, height_sigma_m=2.0):
    frame = Frame(np.zeros((120, 160, 3), np.uint8), 1, CAMERA, 0)
    return PlaceQuery(frame, DOWN, 0.01, heading_sigma_rad, height_m, height_sigma_m)


def smooth(seed, side, channels=3):
    """Features (channels, side, side) int8 as smooth as a network's."""
    values = np.random.default_rng(seed).normal(size=(side, side, channels))
    blurred = cv2.GaussianBlur(values, (0, 0), 1.5)
    return np.rint(blurred * 30 / blurred.std()).clip(-127, 127).astype(np.int8).transpose(2, 0, 1)


def level(features):
    side = features.shape[1] // 16
    ground = np.zeros((side, features.shape[2] // 16), np.float32)
    none = Projection(np.zeros(3, np.float32), np.eye(3, dtype=np.float32))
    return OverviewLevel(features, ground, none, 0.0, 0.0, 0.5)


def test_a_region_is_an_ellipse():
    region = SearchRegion(np.array([10.0, -5.0]), np.diag([36.0, 900.0]))
    assert region.contains(np.array([[10, 24], [15.9, -5], [16.1, -5], [10, 26]])).tolist() == [
        True, True, False, False,
    ]  # fmt: skip
    low, high = region.bounds
    np.testing.assert_allclose((*low, *high), (4, -35, 16, 25))


def test_only_ground_that_a_region_sees_asks_for_heights():
    """A hill at the map's other end asked every search in a town for heights of 10 m."""
    features = np.zeros((3, 1024, 1024), np.int8)
    flat = level(features)
    flat.ground[:, -4:] = 80.0
    asked = replace(query(), region=SearchRegion.circle(np.array([200.0, -200.0]), 50.0))
    assert ground_of(flat, asked).max() == 0
    near = replace(asked, region=SearchRegion.circle(np.array([1700.0, -200.0]), 50.0))
    assert ground_of(flat, near).max() == 80  # within what is seen, if not below
    off = replace(asked, region=SearchRegion.circle(np.array([9000.0, 0.0]), 50.0))
    assert len(trial_heights(off, ground_of(flat, off), CONFIG)) == 0
    assert ground_of(flat, query()).shape == flat.ground.shape


def test_an_overview_that_is_cut_off_in_flight_is_named(tmp_path):
    """numpy's error about a shape named no file and ended `companion localize` with a traceback."""
    features, path = smooth(0, 288), tmp_path / "1.safetensors"
    path.write_bytes(features.tobytes())
    with path.open("r+b") as file:
        kept = FeatureFile(file, 0, features.shape)
        file.truncate(features.size - 1)
    np.testing.assert_array_equal(kept[:, 7:40, 3:9], features[:, 7:40, 3:9])
    with pytest.raises(MapCacheError, match=r"1\.safetensors: cannot be read any more"):
        kept[:, 250:288, :]


def test_scores_are_normalised_correlations():
    features = smooth(0, 288)
    n = 24
    mask = np.zeros((n, n), np.float32)
    mask[4:-4, 4:-4] = 1
    mask[:9, :14] = 0
    # Of the patch every second cell is compared: it has to be smooth.
    patch = smooth(1, n).transpose(1, 2, 0) * cv2.GaussianBlur(mask, (0, 0), 1.5)[..., None]
    correlator = LevelCorrelator(level(features), 1 << 26)
    spectra = transform_patch(patch, mask)
    checked = 0
    for block in correlator.blocks(n):
        scores = correlator.correlate(spectra, block)
        for i, j in ((1, 2), (25, 45), (38, 60), (len(scores) - 1, 20)):
            r, c = block.row + i * ORIGIN_CELLS, block.column + j * ORIGIN_CELLS
            if min(r, c) < 0 or max(r, c) + n > 288:
                continue
            window = features[:, r : r + n, c : c + n].transpose(1, 2, 0) * 0.01
            energy = ((window**2).sum(-1) * mask).sum()
            expected = (window * patch).sum() / np.sqrt(energy * (patch**2).sum())
            # The energy under the patch is summed over 8 cells and interpolated: a few per cent.
            assert scores[i, j] == pytest.approx(expected, rel=0.1, abs=0.01)
            checked += 1
    assert checked >= 6


def test_patches_and_blocks_together_score_as_each_pair_alone():
    """As many patches as are multiplied at once, not each with each block, in any order."""
    rng = np.random.default_rng(3)
    correlator = LevelCorrelator(level(smooth(0, 288)), 0)
    patches = [
        transform_patch(rng.normal(size=(n, n, 3)).astype(np.float32), np.ones((n, n), np.float32))
        for n in (16, 20, 24, 17)
    ]
    blocks = correlator.blocks(24)[:3]
    pairs = [(3, blocks[2]), (0, blocks[0]), (2, blocks[0]), (3, blocks[1]), (1, blocks[2])]
    together = correlator.correlate_all(patches, pairs)
    assert len(together) == len(pairs)
    for scores, (n, block) in zip(together, pairs, strict=True):
        np.testing.assert_allclose(scores, correlator.correlate(patches[n], block), atol=1e-6)
        assert np.abs(scores).max() > 0.01


@pytest.mark.parametrize("n", [40, 64, 65, 96])
@pytest.mark.parametrize(("r", "c"), [(150, 200), (150, 201), (151, 201)])
def test_a_cut_from_the_map_scores_one_where_it_was_cut_and_nowhere_else(n, r, c):
    features = smooth(1, 320)
    cut = features[:, r : r + n, c : c + n].transpose(1, 2, 0).astype(np.float32) * 0.01
    correlator = LevelCorrelator(level(features), 0)  # no budget: nothing is kept
    spectra = transform_patch(cut, np.ones((n, n), np.float32))
    best = []
    for block in correlator.blocks(n):
        scores, moved = peaks(correlator.correlate(spectra, block))
        at = np.unravel_index(int(np.argmax(scores)), scores.shape)
        row, column = (np.array(at) + moved[at]) * ORIGIN_CELLS
        best.append((float(scores[at]), block.row + row, block.column + column))
    best.sort(reverse=True)
    assert best[0][1:] == (r, c)
    assert best[0][0] == pytest.approx(1.0, abs=0.05)
    assert best[1][0] < 0.3


def test_a_patch_of_which_nothing_is_seen_looks_like_no_place():
    """The search of a low, steep view ended with a division by zero."""
    features = smooth(2, 288)
    correlator = LevelCorrelator(level(features), 0)
    unseen = transform_patch(np.zeros((16, 16, 3), np.float32), np.zeros((16, 16), np.float32))
    for block in correlator.blocks(16):
        assert np.abs(correlator.correlate(unseen, block)).max() == 0


class SameFeatures:
    """An extractor that sees the same in every picture."""

    name = "same"

    def extract(self, rgb):
        h, w = rgb.shape[0] // 4, rgb.shape[1] // 4
        features = smooth(9, h).transpose(1, 2, 0).astype(np.float32)
        return FeaturePyramid(
            (FeatureLevel(features, np.ones((h, w), np.float32), 4),), 4 * w, 4 * h
        )


@pytest.mark.parametrize(("r", "c"), [(150, 200), (150, 201), (151, 207)])
def test_a_place_between_the_compared_origins_is_found_where_it_is(r, c):
    """The last one is half a sample from ground so low that the height does not suit it."""
    overview = level(smooth(8, 512))
    n, step = 32, 1.09
    overview.features[:, r : r + n, c : c + n] = smooth(9, n)
    height = n * overview.cell_m / footprint(CAMERA, DOWN, 1.0, 9.0).side_m
    low = height / step**0.5
    overview.ground[:, 14:] = low - height * step**1.5
    asked = query(heading_sigma_rad=0.01, height_m=low, height_sigma_m=0.0)
    view = SearchView(np.full((120, 160, 3), 99, np.uint8), CAMERA)
    apart = replace(CONFIG, extraction_ratio=1.0)
    found = search(view, asked, (LevelCorrelator(overview, 0),), SameFeatures(), apart)
    assert found is not None
    at = found[0].world_from_camera.translation
    np.testing.assert_allclose(at[:2] / overview.cell_m, (c + n / 2, -r - n / 2), atol=0.1)
    assert found[0].score > 0.85


class PictureFeatures:
    """An extractor whose features are the picture's colours, averaged over its cells."""

    name = "colours"

    def extract(self, rgb):
        h, w = rgb.shape[0] // 4, rgb.shape[1] // 4
        cells = cv2.resize(rgb.astype(np.float32) - 128, (w, h), interpolation=cv2.INTER_AREA)
        return FeaturePyramid((FeatureLevel(cells, np.ones((h, w), np.float32), 4),), 4 * w, 4 * h)


def pictured(features, cell_m, centre, side_m, height_m):
    """The strip that shows a square of ground (m), with its camera above `centre`."""
    n = round(side_m / cell_m)
    first = np.rint((np.array([-centre[1], centre[0]]) - side_m / 2) / cell_m).astype(int)
    cut = features[:, first[0] : first[0] + n, first[1] : first[1] + n].transpose(1, 2, 0)
    rgb = cv2.resize((cut.astype(np.int16) + 128).astype(np.uint8), (4 * n, 4 * n))
    image = np.dstack([rgb, np.full((4 * n, 4 * n), 255, np.uint8)])
    focal = height_m * 4 / cell_m
    camera = Camera(4 * n, 4 * n, focal, focal, 2 * n, 2 * n)
    return GroundStrip(image, camera, CameraFootprint(np.zeros(2), side_m / height_m))


def test_equal_ground_is_told_apart_by_what_lies_beside_it():
    """The frame shows the second place better; its strip shows what is about the first."""
    cells = np.stack([cv2.GaussianBlur(x.astype(np.float32), (0, 0), 4) for x in smooth(8, 1024)])
    cells = np.rint(cells * (30 / cells.std())).clip(-127, 127).astype(np.int8)
    right, wrong, n, height = (512, 448), (800, 200), 32, 100.0
    own = np.stack([cv2.GaussianBlur(x.astype(np.float32), (0, 0), 4) for x in smooth(9, n)])
    own = np.rint(own * (30 / own.std())).clip(-127, 127)
    other = smooth(7, n)
    for (r, c), mixed in ((right, own + 0.5 * other), (wrong, own)):
        cells[:, r : r + n, c : c + n] = mixed.clip(-127, 127).astype(np.int8)
    fine = level(cells)
    coarse = cells.reshape(3, 512, 2, 512, 2).mean(axis=(2, 4)).astype(np.int8)
    levels = (fine, replace(level(coarse), gsd_m=1.0))
    place = np.array([right[1] + n / 2, -(right[0] + n / 2)]) * fine.cell_m
    strip = pictured(coarse, 4.0, place, 256.0, height)
    frame = pictured(cells, 2.0, np.array([wrong[1] + 16, -(wrong[0] + 16)]) * 2.0, 64.0, height)
    asked = query(height_m=height, height_sigma_m=0.0)
    correlators = tuple(LevelCorrelator(x, 1 << 26) for x in levels)
    best = []
    for view in (
        SearchView(frame.image, frame.camera),
        SearchView(frame.image, frame.camera, lambda: strip),
    ):
        found = search(view, asked, correlators, PictureFeatures(), CONFIG)
        assert found is not None
        best.append(found[0].world_from_camera.translation[:2])
    there = np.array([wrong[1] + n / 2, -(wrong[0] + n / 2)]) * fine.cell_m
    np.testing.assert_allclose(best, [there, place], atol=2.0)


def test_a_trials_noise_is_that_of_the_ground_it_was_compared_with(monkeypatch):
    """Where most of a block is beyond the map, it was low, and such scores outranked others."""
    whole = level(smooth(8, 512))
    strip = replace(whole, features=whole.features.copy(), ground=whole.ground.copy())
    strip.features[:, :, 96:], strip.ground[:, 6:] = 0, np.nan

    def noise(overview):
        found = []
        monkeypatch.setattr(
            "localizer.relocalization.search.trial_noise",
            lambda *parts: found.append(trial_noise(*parts)) or found[-1],
        )
        asked = query(heading_sigma_rad=0.01, height_m=40.0)
        view = SearchView(np.full((120, 160, 3), 99, np.uint8), CAMERA)
        assert search(view, asked, (LevelCorrelator(overview, 0),), SameFeatures(), CONFIG)
        return found[0][0]

    assert noise(strip) == pytest.approx(noise(whole), rel=0.15)


def test_rough_scores_are_of_every_second_compared_origin():
    """Features twice as smooth hold nothing that the rough pass leaves out."""
    features = np.stack([cv2.GaussianBlur(x.astype(np.float32), (0, 0), 4) for x in smooth(1, 320)])
    correlator = LevelCorrelator(level(np.rint(features * 5).astype(np.int8)), 1 << 26)
    cut = features[:, 100:140, 120:160].transpose(1, 2, 0)
    spectra = transform_patch(cut, np.ones((40, 40), np.float32))
    for block in correlator.blocks(40):
        fine, rough = (correlator.correlate(spectra, block, n) for n in (ORIGIN_CELLS, ROUGH_CELLS))
        np.testing.assert_allclose(rough, fine[::2, ::2], atol=0.05)


def test_a_large_maps_spectra_are_computed_once_a_pass_and_the_place_is_found(monkeypatch):
    """Of all headings, with room for few blocks. Each heading computed all of them anew."""
    overview = level(smooth(8, 1024))
    overview.features[:, 640 : 640 + 32, 333 : 333 + 32] = smooth(9, 32)
    asked = query(height_m=32 * overview.cell_m / footprint(CAMERA, DOWN, 1.0, 9.0).side_m)
    correlator = LevelCorrelator(overview, 5 * 3 * 128 * 65 * 8)
    made, transform = [], scipy.fft.rfft
    monkeypatch.setattr(
        scipy.fft, "rfft", lambda x, *a, **k: (made.append(x.shape), transform(x, *a, **k))[1]
    )
    view = SearchView(np.full((120, 160, 3), 99, np.uint8), CAMERA)
    found = search(view, asked, (correlator,), SameFeatures(), CONFIG)
    assert found is not None
    at = found[0].world_from_camera.translation[:2] / overview.cell_m
    np.testing.assert_allclose(at, (333 + 16, -640 - 16), atol=0.5)
    blocks = len(correlator.blocks(32))
    assert blocks >= 25
    assert blocks <= made.count((3, 256, 256)) <= 2 * blocks


def test_rectified_ground_lies_where_it_is():
    """A camera that looks down obliquely, turned to the north-east: a spot on the ground."""
    rotation = with_heading(so3_exp((np.radians(25), 0, 0)) @ DOWN, np.radians(-40))
    height, spot = 80.0, np.array([13.0, 31.0])
    pixel, inside = CAMERA.project(rotation.T @ np.array([*spot, -height]))
    assert inside
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    u, v = pixel.astype(int)
    image[v - 1 : v + 2, u - 1 : u + 2] = 255
    centre = np.array([10.0, 40.0])
    patch = rectify(image, CAMERA, rotation, height, centre, 128, 0.5)
    rows, columns = np.nonzero(patch.rgb[..., 0] > 100)
    east = centre[0] + (columns.mean() + 0.5 - 64) * 0.5
    north = centre[1] - (rows.mean() + 0.5 - 64) * 0.5
    np.testing.assert_allclose((east, north), spot, atol=0.8)
    assert patch.seen[int(rows[0]), int(columns[0])]


def test_features_are_turned_counter_clockwise_about_their_middle_and_scaled():
    values = np.random.default_rng(4).normal(size=(12, 12, 16)).astype(np.float32)
    of = Rectification(0.3, 80.0, np.zeros(2), 12)
    same, turned = (
        fitted(values, of, of),
        fitted(values, of, replace(of, heading_rad=0.3 + np.pi / 2)),
    )
    np.testing.assert_array_equal(same, values)
    np.testing.assert_allclose(turned, np.rot90(values), atol=1e-5)
    twice = np.kron(values[..., 0], np.ones((2, 2), np.float32))
    back = fitted(twice, replace(of, cells=24), replace(of, heading_rad=0.3 - np.pi / 2))
    np.testing.assert_allclose(back, np.rot90(values[..., 0], -1), atol=1e-5)


def test_a_turned_rectification_is_the_one_of_the_turned_heading():
    """Of a slanting camera, whose footprint turns with the heading: both place the spot alike."""
    image = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(120, 160, 3)), (0, 0), 5)
    image = np.clip(128 + 300 * image, 0, 255).astype(np.uint8)
    rotation = so3_exp((np.radians(20), 0, 0)) @ DOWN
    seen = footprint(CAMERA, rotation, 1.0, 2.0)

    def seen_at(heading):
        c, s = np.cos(heading), np.sin(heading)
        centre = 60.0 * np.array([[c, -s], [s, c]]) @ seen.centre
        patch = rectify(image, CAMERA, with_heading(rotation, heading), 60.0, centre, 64, 1.5)
        grey = patch.rgb.mean(axis=2).astype(np.float32) - 128
        return grey * patch.seen, Rectification(heading, 60.0, centre, 64)

    (first, of), (second, to) = seen_at(1.0), seen_at(1.0 + np.radians(9))
    turned = fitted(first, of, to)
    assert np.corrcoef(turned.ravel(), second.ravel())[0, 1] > 0.95
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] < 0.8
    assert np.corrcoef(fitted(first, to, of).ravel(), second.ravel())[0, 1] < 0.7


def test_heights_cover_the_ground_and_its_error():
    ground = np.array([[0.0, 20.0], [np.nan, -5.0]], np.float32)
    found = trial_heights(query(), ground, CONFIG)
    reach = np.sqrt(CONFIG.scale_step)
    assert found[0] <= 78 * reach
    assert found[-1] >= 107 / reach
    assert (found[1:] / found[:-1] <= CONFIG.scale_step + 1e-9).all()
    assert len(trial_heights(query(), np.full((2, 2), np.nan, np.float32), CONFIG)) == 0


def test_the_height_is_above_roofs_that_the_map_lacks():
    """Photos of a town over a flat satellite map show it 5 to 15 % larger than the heights say."""
    flat = level(np.zeros((3, 32, 32), np.int8))
    flat.ground[:] = ((0.0, 1.0), (np.nan, -1.0))
    asked = query(height_m=120.0, height_sigma_m=3.0)
    over = above_roofs(asked, flat, 8.0, CONFIG)
    seen, bare = (trial_heights(each, flat.ground, CONFIG) for each in (over, asked))
    assert len(seen) == len(bare) == 1  # takes no longer
    assert 120 / CONFIG.scale_step < seen[0] < bare[0] - 4  # bare ground stays within a step
    assert above_roofs(asked, flat, 2.0, CONFIG).height_m == 118
    flat.ground[:] = np.nan
    assert above_roofs(asked, flat, 8.0, CONFIG).height_m == 120


def test_the_shift_of_an_image_is_found_and_moves_the_camera():
    """A frame that shows what the rendering has 12 px to the right of and 20 px below."""
    rng = np.random.default_rng(2)
    ground = cv2.GaussianBlur(rng.normal(size=(60, 70, 6)).astype(np.float32), (0, 0), 1.0)
    sure = np.full((40, 50), 0.7, np.float32)

    def pyramid(row, column):
        features = np.ascontiguousarray(ground[row : row + 40, column : column + 50])
        return (FeatureLevel(features, sure, 8), FeatureLevel(features, sure, 4))

    shift = FrameShift(pyramid(10, 8)).estimate(pyramid(5, 5))
    assert (shift.u, shift.v) == (12.0, 20.0)
    assert shift.score == pytest.approx(0.9, abs=0.1)
    pose = Pose(DOWN, np.array([7.0, 8.0, 100.0]))
    # From 80 m above the ground, north up: right is east, below is south.
    expected = np.array([12.0, -20.0]) * 80.0 / CAMERA.fx
    np.testing.assert_allclose(displacement(pose, CAMERA, shift, 20.0), expected)
    level_view = Pose(so3_exp((np.pi / 2, 0, 0)) @ DOWN, pose.translation)
    assert not displacement(level_view, CAMERA, shift, 20.0).any()  # sees no ground


@pytest.mark.parametrize(
    ("patches", "contradicted", "credible"),
    [
        (PatchAgreement(60, 54, 6.0, 3.5), False, True),
        (PatchAgreement(60, 12, 3.0, 2.1), False, False),
        (PatchAgreement(60, 54, 6.0, 3.5), True, False),
        (None, False, False),
    ],
)
def test_an_answer_needs_the_image_and_no_sensor_against_it(patches, contradicted, credible):
    pose = Pose(DOWN, np.array([0.0, 0.0, 100.0]))
    found = Registration(
        pose, 0.01 * np.eye(6), 0.2, 0.9, 0.5, RegistrationStatus.OK, 1, agreement=patches
    )
    verifier = Verifier(None, None, None, None, CONFIG, IntegrityConfig(), 0.0, 1000, 0)
    together = FusedRegistration(found, contradicted)
    assert verifier.is_credible(together, PlaceCandidate(pose, 0.4), query()) == credible
