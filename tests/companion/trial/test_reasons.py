"""Priors over a map, and why frames fail."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.errors import FootageError
from companion.planning.way import MapHeights
from companion.recorded.flight import (
    CameraGuess,
    Datum,
    Height,
    RecordedFlight,
    RecordedFrame,
    RecordedPosition,
    RecordedView,
    Telemetry,
)
from companion.trial.localize import Localized
from companion.trial.priors import Correction, priors_of
from companion.trial.result import (
    NOT,
    UNKNOWN,
    WORKS,
    Trial,
    main_reason,
    trial_verdict,
    wanted_map,
)
from companion.trial.run import map_reason, reasons
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.kind import MapKind

_HEIGHT = Height(80.0, Datum.ELLIPSOID, 0.1)
CAMERA = CameraGuess(Camera.from_fov(640, 480, 60.0), 2.0, "test")


def _flight(frame, offsets, heights, path=Path("none.png"), course=None):
    """Frames at metres (east, north) about the map's middle."""
    frames = []
    for k, (east, north) in enumerate(offsets):
        at = frame.position(np.array([east, north, 0.0]))
        told = tuple(h(k) if callable(h) else h for h in heights)
        position = RecordedPosition(at.latitude_deg, at.longitude_deg, 3.0, told)
        telemetry = Telemetry(None, position, None, course)
        frames.append(RecordedFrame(f"{k}.png", path, None, telemetry))
    return RecordedFlight("flight", "photos", tuple(frames), CAMERA)


@pytest.fixture(scope="module")
def cache(small_assets):
    return TileCache.open(small_assets.map_cache)


def test_heights_that_cannot_be_true_are_not_used(cache):
    places = [(0.0, 20.0 * k) for k in range(4)]
    above = Height(80.0, Datum.TAKEOFF, 3.0)
    under = Height(cache.frame.origin.height_m - 300.0, Datum.AMSL, 1.0)
    found = priors_of(_flight(cache.frame, places, (above, under)), cache)
    assert found.datum is Datum.TAKEOFF
    assert any("cannot be true over this map" in note for note in found.notes)
    assert all(60.0 < p.clearance_m < 100.0 for p in found.priors)
    lost = priors_of(_flight(cache.frame, places, (under,)), cache)
    assert lost.datum is None
    assert not any(p.height_known or p.is_complete for p in lost.priors)


def test_frames_without_the_height_that_others_have_are_counted(cache):
    """RTK was lost in the flight: half of the photos have a height of another datum."""
    own = replace(_HEIGHT, value_m=cache.frame.origin.height_m + 80.0)
    flight = _flight(cache.frame, [(0.0, 20.0 * k) for k in range(4)], (own,))
    frames = list(flight.frames)
    other = replace(frames[0].telemetry.position, heights=(replace(own, datum=Datum.AMSL),))
    frames[0] = frames[0].with_telemetry(replace(frames[0].telemetry, position=other))
    found = priors_of(replace(flight, frames=tuple(frames)), cache)
    assert [p.height_known for p in found.priors] == [False, True, True, True]
    assert "no usable height in 1 of 4 frames: searched" in found.notes


@pytest.mark.parametrize(
    ("ground_m", "factor", "told"),
    [(30.0, 0.3, 0), (300.0, 0.3, 1), (300.0, 0.6, 0), (300.0, 1.0, 0)],
)
def test_a_map_in_feet_is_named_and_a_slope_by_the_sea_is_none(
    cache, monkeypatch, ground_m, factor, told
):
    """The take-off was 0.7 of the ground's height below the photos: near the sea that is a hill."""
    level_m = MapHeights(cache).height_m(0.0, 20.0) + cache.frame.origin.height_m
    low = cache.manifest.model_copy(update={"geoid_separation_m": level_m - ground_m})
    monkeypatch.setattr(cache, "manifest", low)
    heights = Height(factor * ground_m + 80.0, Datum.AMSL, 3.0), Height(80.0, Datum.TAKEOFF, 2.0)
    notes = priors_of(_flight(cache.frame, [(0.0, 20.0)] * 4, heights), cache).notes
    assert sum("--height-unit ft" in note for note in notes) == told, notes


def test_a_height_of_another_datum_that_disagrees_is_told(cache):
    above = Height(80.0, Datum.TAKEOFF, 3.0)
    high = Height(cache.frame.origin.height_m + 400.0, Datum.ELLIPSOID, 10.0)
    found = priors_of(_flight(cache.frame, [(0.0, 0.0)] * 3, (above, high), course=90.0), cache)
    assert any("check the map's height datum" in note for note in found.notes)
    assert all(p.is_complete and not p.measured for p in found.priors)
    # The image's top points to the course: east.
    np.testing.assert_allclose(-found.priors[0].rotation[:, 1], [1.0, 0.0, 0.0], atol=1e-3)


def test_a_correction_turns_the_camera_in_its_own_axes_and_moves_it(cache):
    above = Height(80.0, Datum.TAKEOFF, 3.0)
    prior = priors_of(_flight(cache.frame, [(0, 0)], (above,), course=0.0), cache).priors[0]
    ahead = Correction(so3_exp([np.radians(10.0), 0.0, 0.0]), np.array([1.0, 2.0, 3.0]), 1.0)
    moved = ahead.applied(prior)
    np.testing.assert_allclose(moved.pose.translation - prior.pose.translation, [1, 2, 3])
    assert moved.rotation[1, 2] == pytest.approx(np.sin(np.radians(10.0)))  # looks north now
    assert moved.tilt_sigma_deg == 1.0


def test_each_failure_has_its_reason(cache, tmp_path):
    rng = np.random.default_rng(0)
    sharp = cv2.resize(rng.uniform(0, 255, (120, 160)).astype(np.uint8), (640, 480))
    white = sharp.copy()
    white[:240] = 255
    images = {
        "good": sharp, "over-exposed": white, "too dark": np.zeros_like(sharp),
        "no contrast": np.full_like(sharp, 128), "blurred": cv2.GaussianBlur(sharp, (0, 0), 6.0),
    }  # fmt: skip
    for name, image in images.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    above = Height(80.0, Datum.TAKEOFF, 3.0)
    places = [(0.0, 0.0)] * len(images) + [(5000.0, 0.0), (0.0, 0.0)]
    flight = _flight(cache.frame, places, (above,), course=0.0)
    paths = [tmp_path / f"{name}.png" for name in images] + [tmp_path / "good.png"] * 2
    frames = [
        RecordedFrame(p.name, p, None, f.telemetry)
        for p, f in zip(paths, flight.frames, strict=True)
    ]
    priors = priors_of(flight, cache).priors
    failed = [Localized(f.name, None, problem="no") for f in frames]
    why = reasons(frames, priors, failed, None)
    for k, name in enumerate(list(images)[1:], 1):
        assert why[k].startswith(name)
    assert why[5].startswith("no map")
    assert why[6].startswith("too few frames agree")
    done = Localized("a", priors[0].pose, np.eye(6), 0.5, True)
    assert reasons(frames[:1], priors[:1], [done], None) == {}


def test_a_search_is_wrong_where_neither_record_nor_registration_agree(cache):
    """A real photo that was found 4 m from the truth counted as wrong: its registration from
    telemetry, 14 m off, was the only reference.
    """
    flight = _flight(cache.frame, [(0.0, 0.0)] * 3, (Height(80.0, Datum.TAKEOFF, 3.0),), course=0.0)
    priors = priors_of(flight, cache).priors

    def found(prior, east_m):
        pose = Pose(prior.rotation, prior.pose.translation + np.array([east_m, 0, 0]))
        return Localized("a", pose, np.eye(6), 0.5, True, True)

    second = tuple(found(p, 14.0) for p in priors)
    searched = {k: found(p, m) for k, (p, m) in enumerate(zip(priors, (3, 20, -30), strict=True))}
    trial = Trial(flight, priors, second, second, searched, None, {}, ())
    assert trial.search_outcome() == (3, 2, 1)
    assert trial.search_results() == {0: "found", 1: "found", 2: "elsewhere"}


def test_a_flat_map_is_named_with_what_to_use_instead(cache):
    """The verdict said "map of another kind than the image", and nothing that could be done."""
    flight = _flight(cache.frame, [(0.0, 0.0)], ())
    flat = "the map is flat without buildings and trees; use a surface model, which has them"
    trial = Trial(flight, (), (), (), {}, None, {0: "blurred", 1: flat, 2: flat}, ())
    assert main_reason(trial).endswith(flat)
    why = map_reason(MapKind("flat", 6.0, 0.5))
    assert why == flat


@pytest.mark.parametrize(
    ("count", "accepted", "kind"),
    [
        (0, False, UNKNOWN), (1, False, UNKNOWN), (3, True, UNKNOWN), (4, False, NOT),
        (4, True, WORKS),
    ],
)  # fmt: skip
def test_too_few_frames_give_no_verdict(cache, count, accepted, kind):
    """One photo of a folder that works was judged as "does not work", another as "works"."""
    flight = _flight(cache.frame, [(0.0, 0.0)] * count, ())
    done = (Localized("a", None, accepted=accepted),) * count
    trial = Trial(flight, priors_of(flight, cache).priors, done, done, {}, None, {}, ())
    assert trial_verdict(trial).kind == kind
    assert trial_verdict(trial).exit_code == (0 if kind == WORKS else 1)


@pytest.mark.parametrize(
    ("change", "slip"),
    [
        (lambda p: (p.longitude_deg, p.latitude_deg), "latitude and longitude are swapped"),
        (lambda p: (p.latitude_deg, -p.longitude_deg), "longitude's sign is wrong"),
        (lambda _: (-35.4, 149.2), "give the map of that place"),
    ],
)
def test_footage_far_from_the_map_is_refused_with_the_likely_slip(cache, change, slip):
    (frame,) = _flight(cache.frame, [(0.0, 0.0)], ()).frames
    position = frame.telemetry.position
    latitude, longitude = change(position)
    wrong = replace(position, latitude_deg=latitude, longitude_deg=longitude)
    moved = frame.with_telemetry(replace(frame.telemetry, position=wrong))
    with pytest.raises(FootageError, match=rf"km from the map.*{slip}"):
        priors_of(RecordedFlight("a", "photos", (moved,), CAMERA), cache)


def test_the_wanted_map_reaches_past_the_footage(cache):
    above = Height(100.0, Datum.TAKEOFF, 3.0)
    flight = _flight(cache.frame, [(0.0, 0.0), (0.0, 200.0)], (above,))
    wanted = wanted_map(flight)
    south = flight.frames[0].telemetry.position.latitude_deg
    assert (south - wanted.south) * 111_320.0 == pytest.approx(150.0, rel=1e-6)
    assert wanted.gsd_m == pytest.approx(100.0 / (CAMERA.camera.fx / 2), rel=1e-6)


def test_the_wanted_map_of_an_oblique_view_lies_where_it_looks(cache):
    above = Height(100.0, Datum.TAKEOFF, 3.0)
    (frame,) = _flight(cache.frame, [(0.0, 0.0)], (above,)).frames
    east = RecordedView.of_angles(0.0, -30.0, 90.0, 1.0, 1.0)
    oblique = frame.with_telemetry(replace(frame.telemetry, view=east))
    wanted = wanted_map(RecordedFlight("a", "video", (oblique,), CAMERA))
    at = frame.telemetry.position
    metres = 111_320.0 * np.cos(np.radians(at.latitude_deg))
    assert (wanted.east - at.longitude_deg) * metres == pytest.approx(100 * 3**0.5 + 150, rel=1e-3)
    assert (at.longitude_deg - wanted.west) * metres == pytest.approx(150.0, rel=1e-3)
