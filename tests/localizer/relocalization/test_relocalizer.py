"""A frame of another day, found on a small world of 400 m: and what is not there is not found."""

import errno
import logging
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.errors import MapCacheError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.jngo import JNGO
from localizer.relocalization import search as searching
from localizer.relocalization import verdict
from localizer.relocalization.correlate import ORIGIN_CELLS, ROUGH_CELLS, LevelCorrelator
from localizer.relocalization.kept_overviews import drop_old, mark_used
from localizer.relocalization.overview import open_overview, overview_key
from localizer.relocalization.patch import footprint, rectify, with_heading
from localizer.relocalization.relocalizer import open_relocalizer
from localizer.relocalization.strip import lay_together
from localizer.relocalization.types import (
    EarlierFrame,
    PlaceCandidate,
    PlaceQuery,
    SearchRegion,
)
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import DOWN
from localizer.types import Frame

CONFIG = LocalizerConfig(renderer="numba", threads=1)
CAMERA = Camera.from_fov(320, 240, 65.0)
PLACE = np.array([40.0, -35.0])


@pytest.fixture(scope="module")
def cache(small_assets, tmp_path_factory):
    """A copy, so that the overview is put nowhere else."""
    folder = tmp_path_factory.mktemp("overview") / "map"
    shutil.copytree(small_assets.map_cache, folder)
    return TileCache.open(folder)


@pytest.fixture(scope="module")
def opened(cache):
    opened = open_relocalizer(cache, CONFIG)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def truth(small_assets):
    ground = float(small_assets.world.ground_height(*PLACE))
    rotation = with_heading(so3_exp((np.radians(20), 0, 0)) @ DOWN, np.radians(143))
    return Pose(rotation, np.array([*PLACE, ground + 110.0]))


def seen_from(truth, assets):
    """The image (H, W, 3) of another day."""
    with TileStreamer(TileCache.open(assets.live_cache)) as streamer:
        renderer = NumbaRenderer(streamer, 1)
        rgb = renderer.render(truth, CAMERA, wait=True).rgb
        renderer.close()
    return rgb


@pytest.fixture(scope="module")
def query(small_assets, truth):
    """The frame of another day; the heading that is given is 100 degrees off, the height 2 m."""
    return PlaceQuery(
        Frame(seen_from(truth, small_assets), 123, CAMERA, 7),
        with_heading(so3_exp((0.005, -0.004, 0)) @ truth.rotation, np.radians(100)),
        tilt_sigma_rad=np.radians(0.7),
        heading_sigma_rad=None,
        height_m=float(truth.translation[2]) + 2.0,
        height_sigma_m=2.0,
    )


def test_found_with_no_idea_of_place_or_heading(opened, query, truth):
    found = opened.relocalizer.find(query)
    metres, degrees = found.world_from_camera.distance_to(truth)
    assert (metres < 1.0, degrees < 0.5) == (True, True)
    assert found.exposure_time_ns == 123
    assert found.quality > found.rival_quality
    assert found.separation > 1.0
    off = found.world_from_camera.translation - truth.translation
    assert off @ np.linalg.solve(found.covariance[:3, :3], off) < 30


def test_frames_of_the_seconds_before_lead_to_the_place(
    opened, query, truth, small_assets, monkeypatch
):
    """Laid together they are compared with the coarser level, and its best places looked at."""
    earlier = []
    for k in range(1, 6):
        way = k * np.array([-13.0, 7.0, 1.5])
        pose = Pose(truth.rotation, truth.translation + way)
        frame = Frame(seen_from(pose, small_assets), 123 - k, CAMERA, 7 - k)
        earlier.append(EarlierFrame(frame, query.rotation, 1.5 * k))
    monkeypatch.setattr(searching, "_MOST_PAIRS", 8)
    made, compared = [], []
    monkeypatch.setattr(
        "localizer.relocalization.relocalizer.lay_together",
        lambda *a: made.append(lay_together(*a)) or made[-1],
    )
    correlate = LevelCorrelator.correlate_all
    monkeypatch.setattr(
        LevelCorrelator, "correlate_all",
        lambda self, *a: compared.append((self.level.gsd_m, a[2])) or correlate(self, *a),
    )  # fmt: skip
    candidates = opened.relocalizer.search(replace(query, earlier=tuple(earlier)))
    (strip,) = made
    side_m = strip.seen.side_m * 110.0
    assert 1.2 * footprint(CAMERA, truth.rotation, 110.0, 340.0).side_m < side_m < 340.0
    assert set(compared) == {(1.0, ROUGH_CELLS), (0.5, ORIGIN_CELLS)}
    off = candidates[0].world_from_camera.translation[:2] - truth.translation[:2]
    assert np.linalg.norm(off) < 10.0
    assert opened.relocalizer.confirm(query, candidates) is not None
    # On the ground, where the last seconds are as nothing.
    stands = replace(query, height_m=query.height_m - 110.0, earlier=(replace(
        earlier[0], frame=query.frame, higher_m=0.0),))  # fmt: skip
    assert opened.relocalizer.search(stands)
    assert len(made) == 2


def test_a_twin_that_is_as_credible_forbids_an_answer(opened, query, truth, monkeypatch):
    """Equal roofs: both places agree, so neither is given; a rival that disagrees is none."""
    relocalizer = opened.relocalizer
    candidates = relocalizer.search(query)
    best, *_ = relocalizer.verify(query, candidates)
    away = Pose(truth.rotation, truth.translation + np.array([60.0, 0.0, 0.0]))
    result = replace(best.result, world_from_camera=away, quality=best.result.quality - 0.01)
    for credible in (True, False):
        twin = replace(best, rank=1, result=result, credible=credible)
        monkeypatch.setattr(relocalizer, "verify", lambda *_, twin=twin: [best, twin])
        assert (relocalizer.confirm(query, candidates) is None) is credible


def test_a_place_that_stands_out_need_not_be_decisive(opened, query, truth, monkeypatch):
    """Other ground looks alike from above. It is no rival where its own registration says so; where
    it fits nearly as badly as the answer, or was never looked at, there is none.
    """
    relocalizer = opened.relocalizer
    best, *_ = relocalizer.verify(query, relocalizer.search(query)[:1])
    best = replace(best, log_odds=3.0)
    assert not best.is_decisive
    away = Pose(truth.rotation, truth.translation + np.array([60.0, 0.0, 0.0]))
    candidates = [best.candidate, PlaceCandidate(away, best.candidate.score)]

    def decide(share, looked_at=True):
        result = replace(best.result, world_from_camera=away, quality=share * best.result.quality)
        other = replace(best, rank=1, result=result, credible=False)
        registered = [best, other] if looked_at else [best]
        monkeypatch.setattr(relocalizer, "verify", lambda *_: registered)
        return relocalizer.confirm(query, candidates)

    assert decide(0.5) is not None
    assert decide(0.9) is None
    assert decide(0.5, looked_at=False) is None


def test_ground_that_looks_alike_costs_few_registrations(cache, query, truth, monkeypatch):
    """Forty places whose ground looks like the frame from above: rendered, the others do not. Each
    was registered before, and the one that was not left no answer.
    """
    registered = []
    register = JNGO.register
    monkeypatch.setattr(JNGO, "register", lambda *a, **k: registered.append(1) or register(*a, **k))
    monkeypatch.setattr(verdict, "DECISIVE", np.inf)
    with open_relocalizer(cache, CONFIG) as found:
        best = found.search(query)[0]
        places = [np.array([x, y]) for x in range(-160, 161, 40) for y in (-150, -90, 30, 90, 150)]
        alike = [
            replace(best, world_from_camera=Pose(truth.rotation, np.array([*p, query.height_m])))
            for p in places
        ]
        registered.clear()
        answer = found.confirm(query, [*alike[:20], best, *alike[20:]])
    assert answer.world_from_camera.distance_to(truth)[0] < 1.0
    assert len(registered) <= 12


def test_a_doubt_that_the_last_pass_leaves_is_settled(opened, query, truth, monkeypatch):
    """Decisive at first, no other candidate was registered; no longer decisive at the end, they
    have to be known not to be the place.
    """
    best = opened.relocalizer.search(query)[0]
    alike = [
        replace(best, world_from_camera=Pose(truth.rotation, np.array([x, 120.0, query.height_m])))
        for x in (-120.0, -60.0, 0.0, 60.0, 120.0)
    ]
    register, calls = JNGO.register, []

    def doubtful_later(*args, **options):
        result = register(*args, **options)
        calls.append(1)
        votes = result.agreement
        if len(calls) == 1 or votes is None or votes.share < 0.5:
            return result
        return replace(result, agreement=replace(votes, votes=round(0.5 * votes.patches)))

    monkeypatch.setattr(JNGO, "register", doubtful_later)
    answer = opened.relocalizer.confirm(query, [best, *alike])
    assert answer.world_from_camera.distance_to(truth)[0] < 1.0


def test_a_low_camera_among_high_houses_is_found_from_candidates_aside(opened, small_assets):
    """Their roofs lean outwards: flat ground fits best up to 12 m beside the place, from where
    a registration alone found two of eight back (the flight covered-10s was not found again).
    """
    place, up_m = np.array([36.5, 63.7]), 62.0
    rotation = with_heading(so3_exp((np.radians(10), 0, 0)) @ DOWN, np.radians(-90))
    truth = Pose(rotation, np.array([*place, up_m]))
    query = PlaceQuery(
        Frame(seen_from(truth, small_assets), 123, CAMERA, 7),
        with_heading(truth.rotation, np.radians(4)),
        tilt_sigma_rad=np.radians(1),
        heading_sigma_rad=np.radians(10),
        height_m=up_m + 1.0,
        height_sigma_m=3.0,
        region=SearchRegion.circle(place + 3.0, 30.0),
    )
    errors = []
    for angle in np.arange(8) * np.pi / 4:
        aside = np.array([*(place + 10 * np.array([np.cos(angle), np.sin(angle)])), query.height_m])
        candidate = PlaceCandidate(Pose(query.rotation, aside), 0.4)
        best = opened.relocalizer.verify(query, [candidate])[0]
        errors.append(best.result.world_from_camera.distance_to(truth)[0] if best.credible else 99)
    assert max(errors) < 0.5, errors
    assert opened.relocalizer.find(query) is not None


def test_the_region_is_kept(opened, query, truth):
    near = SearchRegion.circle(truth.translation + 20.0, 60.0)
    places = opened.relocalizer.search(replace(query, region=near))
    xy = np.array([c.world_from_camera.translation[:2] for c in places])
    assert near.contains(xy).all()
    assert np.linalg.norm(xy[0] - PLACE) < 15
    elsewhere = SearchRegion.circle(-truth.translation, 40.0)
    assert opened.relocalizer.find(replace(query, region=elsewhere)) is None


def test_a_heading_that_is_known_is_kept(opened, query, truth):
    wrong = replace(query, heading_sigma_rad=np.radians(5))  # it is 100 degrees off
    assert opened.relocalizer.find(wrong) is None


def test_a_frame_of_nowhere_is_not_found(opened, query):
    noise = np.random.default_rng(3).integers(0, 255, (15, 20, 3)).astype(np.uint8)
    blocks = np.kron(noise, np.ones((16, 16, 1), np.uint8))
    frame = replace(query.frame, image=blocks)
    near = SearchRegion.circle(PLACE, 80.0)
    assert opened.relocalizer.find(replace(query, frame=frame, region=near)) is None


def test_a_covered_lens_is_not_searched_for(opened, query):
    """Its search would go on for seconds, over the first frames that show something again."""
    noise = np.random.default_rng(1).normal(8.0, 2.0, query.frame.image.shape)
    dark = replace(query.frame, image=noise.clip(0, 255).astype(np.uint8))
    asked = []
    assert opened.relocalizer.search(replace(query, frame=dark), lambda: asked.append(1)) == []
    assert not asked
    dull = (0.1 * query.frame.image.astype(np.float32)).astype(np.uint8)  # a dark night is

    def stop():
        asked.append(1)
        return True

    opened.relocalizer.search(replace(query, frame=replace(dark, image=dull)), stop)
    assert asked


def test_stops_when_told(opened, query, monkeypatch):
    calls, looked = [], []
    monkeypatch.setattr(searching, "rectify", lambda *a: looked.append(a) or rectify(*a))

    def stop():
        calls.append(1)
        return len(calls) > 3

    assert opened.relocalizer.find(query, stop) is None
    assert 1 <= len(looked) <= 3  # stopped before the next heading, not at the end


def test_the_overview_is_kept_and_a_damaged_one_is_made_again(cache, opened, monkeypatch, caplog):
    monkeypatch.setattr("localizer.relocalization.overview._STRIP_CELLS", 32)  # the same in strips
    first = opened.relocalizer.overview
    folder = cache.path / "overview" / first.key
    files = sorted(folder.iterdir())
    assert [f.suffix for f in files] == [".safetensors"] * 3
    small = folder / "2.safetensors"
    stamps = {f: f.stat().st_mtime_ns for f in files}
    content = bytearray(small.read_bytes())
    content[500] ^= 255
    small.write_bytes(content)
    with TileStreamer(cache) as streamer, caplog.at_level(logging.WARNING):
        renderer = NumbaRenderer(streamer, 1)
        extractor = opened.relocalizer.extractor
        again = open_overview(cache, renderer, extractor)
        assert "2.safetensors: damaged" in caplog.text
        for a, b in zip(first.levels, again.levels, strict=True):
            np.testing.assert_array_equal(a.features[:, :, :], b.features[:, :, :])
            np.testing.assert_array_equal(a.ground, b.ground)
        caplog.clear()
        open_overview(cache, renderer, extractor)
        assert not caplog.records
        renderer.close()
    assert stamps[files[0]] == files[0].stat().st_mtime_ns  # the whole ones were left alone


def test_overviews_of_models_that_are_no_longer_used_are_removed(tmp_path):
    """Each model that was tried left 5 MB a km² in the map's folder for good."""
    now, mine = time.time(), tmp_path / "0123456789abcdef"
    for k, name in enumerate(["a" * 16, "b" * 16, "c" * 16, mine.name, "d" * 16, "notes"]):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1.safetensors").touch()
        os.utime(tmp_path / name, (now - 100 + k, now - 100 + k))
    for name, age_s in (("1.new", 2e5), ("2.new", 5.0)):
        (mine / name).touch()
        os.utime(mine / name, (now - age_s, now - age_s))
    mark_used(tmp_path / ("a" * 16))  # by another deployment, just now
    drop_old(mine)
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == sorted([mine.name, "a" * 16, "d" * 16, "notes"])
    assert sorted(path.name for path in mine.iterdir()) == ["1.safetensors", "2.new"]
    drop_old(tmp_path / "nowhere" / ("f" * 16))  # a map that is only read has none
    mark_used(tmp_path / "nowhere")


def test_a_map_that_is_only_read_is_searched_all_the_same(cache, opened, monkeypatch, caplog):
    """Its partial overview cannot be finished there; the error of removing a file that was never
    made cost the search. So did a folder of another user, where nobody may look.
    """
    folder = cache.path / "overview" / opened.relocalizer.overview.key
    kept = (folder / "2.safetensors").read_bytes()
    (folder / "2.safetensors").unlink()

    stat = os.stat

    def read_only(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    def hidden(path, *args, **more):
        if folder in Path(path).parents:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, *args, **more)

    with TileStreamer(cache) as streamer, caplog.at_level(logging.WARNING):
        renderer = NumbaRenderer(streamer, 1)
        with monkeypatch.context() as patched:
            patched.setattr(Path, "unlink", read_only)
            patched.setattr(os, "fsync", read_only)
            patched.setattr(os, "stat", hidden)
            found = open_overview(cache, renderer, opened.relocalizer.extractor)
        renderer.close()
    for left in folder.glob("*.new"):
        left.unlink()
    (folder / "2.safetensors").write_bytes(kept)
    assert found is not None
    assert "computed at every start" in caplog.text


def test_a_map_whose_search_does_not_fit_into_memory_is_named(cache, opened, monkeypatch):
    monkeypatch.setattr("localizer.relocalization.overview.available_bytes", lambda: 1 << 16)
    with pytest.raises(MapCacheError, match=r"search of .* km² takes \d+ MiB, more than half of"):
        open_relocalizer(cache, CONFIG)
    monkeypatch.setattr("localizer.relocalization.overview.available_bytes", lambda: None)
    with open_relocalizer(cache, CONFIG) as found:
        assert found.overview.key == opened.relocalizer.overview.key


def test_another_map_or_model_has_an_overview_of_its_own(cache):
    other = TileCache(
        cache.path, cache.manifest.model_copy(update={"index_sha256": "0" * 64}), cache.index
    )
    keys = {overview_key(c, m) for c in (cache, other) for m in ("tiny", "another")}
    assert len(keys) == 4
