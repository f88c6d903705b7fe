"""The dual-thread engine over fakes of the renderer, the network and the optimizer."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.errors import CameraError, MapCacheError, OutsideMapError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.registration.agreement import PatchAgreement
from localizer.registration.result import Registration
from localizer.render.base import SKY
from localizer.tracking import pipeline
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.pipeline import Localizer, Undistorter, working_camera
from localizer.types import (
    FeatureLevel,
    FeaturePyramid,
    Frame,
    PosePrior,
    RegistrationStatus,
    RenderedView,
    TrackingState,
)

CAMERA = Camera.from_fov(640, 480, 60.0)
NADIR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 100.0]))
INTERVAL_NS = 20_000_000


class FakeRenderer:
    name = "fake"

    def __init__(self) -> None:
        self.depth = 100.0
        self.poses: list[Pose] = []
        self.ahead: list[tuple[str, list[Pose]]] = []
        self.error: Exception | None = None

    def prefetch(self, views, camera):
        self.ahead.append((threading.current_thread().name, list(views)))
        if self.error is not None:
            raise self.error

    def render(self, world_from_camera, camera, extra=(), *, wait=False):
        self.poses.append(world_from_camera)
        rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
        depth = np.full(rgb.shape[:2], self.depth, np.float32)
        return RenderedView(rgb, depth, world_from_camera, camera)


class FakeExtractor:
    name = "fake"

    def extract(self, rgb):
        h, w = rgb.shape[:2]
        rng = np.random.default_rng(0)
        levels = tuple(
            FeatureLevel(
                rng.standard_normal((h // s, w // s, 4)).astype(np.float32),
                np.ones((h // s, w // s), np.float32),
                s,
            )
            for s in (8, 4, 2)
        )
        return FeaturePyramid(levels, w, h)


class FakeOptimizer:
    """Finds the camera where `truth` says it is, 1 cm off; or raises what `error` holds."""

    on_gpu = False
    backend = SimpleNamespace(name="fake")

    def __init__(self) -> None:
        self.error: Exception | None = None
        self.status = RegistrationStatus.OK
        self.offset = np.zeros(3)
        self.agreement = PatchAgreement(patches=60, votes=58, peak=6.0, patch_peak=3.5)
        self.focal_gain = -np.inf

    def register(self, query, camera, anchors, prior, *, motion=None, constraint=None, seed=0):
        if self.error is not None:
            raise self.error
        pose = Pose(NADIR.rotation, NADIR.translation + 0.01 + self.offset)
        return Registration(pose, np.eye(6) * 0.01, 0.1, 0.9, 0.8, self.status, 1, self.agreement)

    def with_focal_gain(self, query, camera, anchors, found):
        return replace(found, focal_gain=self.focal_gain)


def _localizer(renderer=None, optimizer=None) -> Localizer:
    return Localizer(
        renderer or FakeRenderer(),
        FakeExtractor(),
        optimizer or FakeOptimizer(),  # type: ignore[arg-type]
        CAMERA,
        # The fake optimizer registers to the map alone; each frame has its own reference.
        LocalizerConfig(odometry=None, reference_shift_px=0),
    )


def _frame(sequence: int) -> Frame:
    image = np.zeros((480, 640, 3), np.uint8)
    return Frame(image, 10**9 + sequence * INTERVAL_NS, CAMERA, sequence)


def _prior(time_ns: int) -> PosePrior:
    return PosePrior(NADIR, np.eye(6), time_ns)


class Flight:
    """An engine, its estimates, and frames on demand."""

    def __init__(
        self, localizer: Localizer, provider=_prior, searcher=None, clock=time.monotonic_ns
    ) -> None:
        self.estimates: list[Any] = []
        self.localizer, self.provider = localizer, provider
        self.engine = DualThreadEngine(
            localizer,
            (lambda e, _: self.estimates.append(e),),
            lambda time_ns: self.provider(time_ns),  # noqa: PLW0108 (a test replaces it)
            searcher,
            clock,
        )
        self.sequence = 0
        self.engine.start()

    def feed_until(self, condition, timeout_s=60.0):
        """Frames until something holds, at the engine's pace: the exposures' clock stands still
        until all threads have done with a frame, or a starved machine would run through seconds
        of flight (and begin searches) between two frames that are looked at.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, self.engine.health
            submitted_ns = time.monotonic_ns()
            self.engine.submit(_frame(self.sequence))
            self.sequence += 1
            handed_over_ns = self._turn_after("extract", submitted_ns, deadline)
            localized_ns = self._turn_after("localize", handed_over_ns, deadline)
            self._turn_after("render", localized_ns, deadline)

    def _turn_after(self, thread: str, time_ns: int, deadline: float) -> int:
        """Wait until a thread begins a new turn, and so has ended what it took; when it began."""
        while (begun_ns := self.engine.last_ticks_ns().get(thread, 0)) <= time_ns:
            assert time.monotonic() < deadline, f"{thread} stands: {self.engine.health}"
            time.sleep(1e-3)
        return begun_ns


@pytest.fixture
def flight(request):
    flights = []

    def start(*args, **kwargs) -> Flight:
        flights.append(Flight(*args, **kwargs))
        return flights[-1]

    yield start
    for f in flights:
        f.engine.stop()


def threads() -> set[str]:
    """The engine's that run; others may be an earlier test's."""
    return {t.name for t in threading.enumerate()} & {"render", "extract", "localize"}


def test_reaches_tracking_from_a_prior_and_stops_cleanly(flight):
    f = flight(_localizer())
    f.feed_until(lambda: f.estimates and f.estimates[-1].state is TrackingState.TRACKING)
    estimate = f.estimates[-1]
    assert estimate.accepted
    assert set(estimate.stage_ms) == {"reference", "extract", "register", "latency"}
    assert threads() == {"render", "extract", "localize"}
    f.engine.stop()
    assert not threads()


def test_the_map_is_loaded_along_the_way_ahead(flight, monkeypatch):
    renderer = FakeRenderer()
    localizer = _localizer(renderer)
    way = np.array([20.0, 0.0, 0.0])  # m/s

    def predict(time_ns):
        return PosePrior(Pose(NADIR.rotation, way * time_ns * 1e-9), np.eye(6), time_ns)

    monkeypatch.setattr(localizer, "predict", predict)
    localizer.prefetch(500_000_000)
    _, views = renderer.ahead.pop()
    assert [v.translation[0] for v in views] == pytest.approx([30.0, 70.0])
    f = flight(_localizer(renderer))
    f.feed_until(lambda: len(f.estimates) >= 5 and len(renderer.ahead) >= 4)
    assert {thread for thread, _ in renderer.ahead} == {"render"}


def test_loading_ahead_that_fails_costs_no_reference(flight):
    renderer = FakeRenderer()
    renderer.error = MapCacheError("the disk is gone")
    f = flight(_localizer(renderer))
    f.feed_until(lambda: f.engine.health.accepted >= 3 and f.engine.health.errors > 0)
    health = f.engine.health
    assert (health.renderer, health.features, health.optimizer) == ("fake", "fake", "fake")


def test_without_a_prior_nothing_is_estimated(flight):
    f = flight(_localizer(), provider=lambda _: None)
    with pytest.raises(AssertionError):
        f.feed_until(lambda: bool(f.estimates), timeout_s=1.0)
    assert f.engine.health.errors == 0


def test_an_error_on_a_thread_is_reported_and_survived(flight):
    optimizer = FakeOptimizer()
    f = flight(_localizer(optimizer=optimizer))
    f.feed_until(lambda: bool(f.estimates))
    optimizer.error = RuntimeError("boom")
    f.feed_until(lambda: "boom" in f.engine.health.last_error)
    optimizer.error = None
    count = len(f.estimates)
    f.feed_until(lambda: len(f.estimates) > count + 2)
    assert f.engine.health.last_error == ""
    assert f.engine.health.errors > 0


def test_leaving_the_map_is_named_and_survived(flight):
    renderer = FakeRenderer()
    renderer.depth = 0.0
    f = flight(_localizer(renderer=renderer))
    f.feed_until(lambda: "does not meet the map" in f.engine.health.last_error)
    renderer.depth = 100.0
    f.feed_until(lambda: bool(f.estimates))


def test_a_lost_tracker_asks_outside_and_comes_back(flight):
    optimizer, asked = FakeOptimizer(), []
    f = flight(_localizer(optimizer=optimizer), lambda t: asked.append(t) or _prior(t))
    f.feed_until(lambda: f.estimates and f.estimates[-1].state is TrackingState.TRACKING)
    before = len(asked)
    optimizer.status = RegistrationStatus.NO_OVERLAP
    f.feed_until(lambda: any(e.state is TrackingState.LOST for e in f.estimates))
    assert not next(e for e in f.estimates if e.state is TrackingState.LOST).accepted
    f.feed_until(lambda: len(asked) > before)
    # It stays lost while the pose asked for is tried and does not hold.
    count = len(f.estimates)
    f.feed_until(lambda: len(f.estimates) > count + 5)
    assert {e.state for e in f.estimates[count:]} == {TrackingState.LOST}
    optimizer.status = RegistrationStatus.OK
    f.feed_until(lambda: f.estimates[-1].state is TrackingState.TRACKING)


def test_a_jump_against_the_prediction_is_not_accepted():
    optimizer = FakeOptimizer()
    localizer = _localizer(optimizer=optimizer)
    localizer.set_prior(_prior(10**9))
    anchors = localizer.make_reference(_prior(10**9)).anchors
    for k in range(1, 6):
        frame = _frame(k)
        assert localizer.localize(frame, localizer.extract_query(frame), anchors).accepted
    optimizer.offset = np.array([40.0, 0.0, 0.0])
    frame = _frame(6)
    assert not localizer.localize(frame, localizer.extract_query(frame), anchors).accepted


@pytest.mark.parametrize(("sigma_m", "accepted"), [(3.0, True), (20.0, False)])
def test_of_equal_roofs_only_a_narrow_prior_says_which(sigma_m, accepted):
    optimizer = FakeOptimizer()
    optimizer.agreement = PatchAgreement(patches=60, votes=22, peak=4.2, patch_peak=2.3)
    localizer = _localizer(optimizer=optimizer)
    localizer.set_prior(PosePrior(NADIR, np.diag([sigma_m**2] * 3 + [1.0] * 3), 10**9))
    assert localizer.track(_frame(0)).accepted is accepted


@pytest.mark.parametrize(("gain", "tried"), [(-0.01, 1), (0.05, 0)])
def test_a_found_place_is_refused_where_another_focal_length_fits_better(gain, tried):
    optimizer = FakeOptimizer()
    optimizer.focal_gain = gain
    localizer = _localizer(optimizer=optimizer)
    localizer.offer(replace(_prior(10**9), independent=False))
    localizer.track(_frame(0))
    assert localizer.tracker.track_status.accepted_in_row == tried


def test_localizing_before_a_prior_is_an_error():
    localizer = _localizer()
    with pytest.raises(OutsideMapError, match="no pose prior"):
        localizer.localize(_frame(0), FakeExtractor().extract(np.zeros((240, 320, 3))), None)
    with pytest.raises(OutsideMapError, match="no pose prior"):
        localizer.track(_frame(0))


def test_a_frame_is_tracked_in_one_call_as_in_its_two_halves():
    whole, halves = _localizer(), _localizer()
    for localizer in (whole, halves):
        localizer.set_prior(_prior(10**9))
    for k in range(1, 5):
        frame = _frame(k)
        tracked = whole.track(frame)
        prior = halves.predict(frame.exposure_time_ns)
        anchors = halves.make_reference(prior, wait=True).anchors
        localized = halves.localize(frame, halves.extract_query(frame), anchors)
        assert tracked.accepted
        np.testing.assert_array_equal(
            tracked.world_from_camera.matrix, localized.world_from_camera.matrix
        )
        assert tracked.state is localized.state
    assert {"reference", "extract", "register"} <= set(tracked.stage_ms)
    # No second set of features of the frame, and no evidence from it counted twice.
    again = _localizer(renderer := FakeRenderer())
    again.set_prior(_prior(10**9))
    assert again.track(_frame(0), passes=3, query=lambda: whole.extract_query(_frame(0))).accepted
    assert len(renderer.poses) == 3
    assert again.tracker.track_status.accepted_in_row == 1


def test_an_image_that_an_earlier_pass_refused_is_refused(monkeypatch):
    localizer, odds = _localizer(), iter([np.inf, -1.0])
    monkeypatch.setattr(pipeline, "log_odds", lambda _found: next(odds))
    localizer.set_prior(_prior(10**9))
    assert not localizer.track(_frame(0), passes=3).accepted


def test_a_frame_of_another_size_is_named():
    undistort = Undistorter(CAMERA, working_camera(CAMERA, 320))
    bad = Frame(np.zeros((100, 100, 3), np.uint8), 0, CAMERA, 7)
    with pytest.raises(CameraError, match="frame 7 is 100x100"):
        undistort(bad)


def test_a_stream_that_changes_its_size_is_undistorted_with_its_own_camera():
    """The same lens at half the size gives the same working image, but for sampling."""
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (-0.12, 0.03, 0.001, -0.0005, 0.0))
    seen: list[Any] = []
    extractor = SimpleNamespace(extract=seen.append)
    localizer = Localizer(
        FakeRenderer(), extractor, FakeOptimizer(), camera, LocalizerConfig(odometry=None)
    )
    ramp = np.broadcast_to(np.linspace(0, 255, 640).astype(np.uint8)[None, :, None], (480, 640, 3))
    half = cv2.resize(np.ascontiguousarray(ramp), (320, 240), interpolation=cv2.INTER_AREA)
    for image, its in ((ramp, camera), (half, camera.resized(320, 240)), (ramp, camera)):
        localizer.extract_query(Frame(np.ascontiguousarray(image), 0, its, 0))
    assert [image.shape for image in seen] == [(240, 320, 3)] * 3
    inner = np.s_[20:-20, 20:-20]  # both are black outside the lens's picture
    np.testing.assert_allclose(seen[1][inner].astype(float), seen[0][inner], atol=2.5)
    np.testing.assert_array_equal(seen[2], seen[0])


def test_features_of_a_reference_do_not_see_the_maps_holes():
    class Holed(FakeRenderer):
        def render(self, world_from_camera, camera, extra=(), *, wait=False):
            view = super().render(world_from_camera, camera, extra, wait=wait)
            depth = view.depth.copy()
            depth[50:90, 100:140] = 0
            rgb = np.where(depth[..., None] > 0, 70, SKY).astype(np.uint8)
            return replace(view, rgb=rgb, depth=depth)

    seen = []

    class Watching(FakeExtractor):
        def extract(self, rgb):
            seen.append(rgb)
            return super().extract(rgb)

    localizer = Localizer(
        Holed(), Watching(), FakeOptimizer(), CAMERA, LocalizerConfig(odometry=None)
    )
    anchors = localizer.make_reference(_prior(10**9)).anchors
    assert (seen[0] == 70).all()
    assert len(anchors.points_world) > 0


@pytest.mark.parametrize("size", [(640, 480), (1024, 768), (1280, 720), (1920, 1080), (2704, 1520)])
def test_undistorted_image_agrees_with_the_projection(size):
    """A dot drawn where the distorted camera sees a point is found where the pinhole sees it."""
    camera = Camera(size[0], size[1], 0.8 * size[0], 0.8 * size[0], 0.51 * size[0], 0.49 * size[1],
                    (-0.12, 0.03, 0.001, -0.0005, 0.0))  # fmt: skip
    target = working_camera(camera, 320)
    assert target.width % 8 == 0
    assert target.height % 8 == 0
    point = np.array([0.3, -0.2, 1.0])
    source_pixel, _ = camera.project(point)
    u, v = np.mgrid[0 : size[0], 0 : size[1]] + 0.5
    sigma = 0.01 * size[0]
    dot = np.exp(-((u - source_pixel[0]) ** 2 + (v - source_pixel[1]) ** 2) / (2 * sigma**2)).T
    image = np.repeat((dot * 255).astype(np.uint8)[..., None], 3, axis=2)
    seen = Undistorter(camera, target)(Frame(image, 0, camera, 0))[..., 0].astype(float)
    rows, columns = np.indices(seen.shape) + 0.5
    centroid = np.array([(columns * seen).sum(), (rows * seen).sum()]) / seen.sum()
    expected, _ = target.project(point)
    np.testing.assert_allclose(centroid, expected, atol=0.15)


class NearOptimizer(FakeOptimizer):
    """Finds a camera that flies at 10 m/s, if the prior is within 12 m of it."""

    true_ns = 0

    def register(self, query, camera, anchors, prior, *, motion=None, constraint=None, seed=0):
        self.offset = np.array([10.0, 0.0, 0.0]) * (self.true_ns - 10**13) * 1e-9
        away = prior.world_from_camera.translation - NADIR.translation - self.offset
        far = np.linalg.norm(away) > 12.0
        self.status = RegistrationStatus.NO_OVERLAP if far else RegistrationStatus.OK
        return super().register(query, camera, anchors, prior)


@pytest.mark.parametrize("jump_s", [4e9, 3 * 3600.0, -3 * 3600.0, 20.0, 1.0, -1.0, -0.15])
@pytest.mark.parametrize("frames", [1, 3, 100])
def test_frames_of_a_wrong_time_are_got_over(jump_s, frames):
    """Camera times that run back or leap ahead, for some frames or for good; no help outside."""
    optimizer = NearOptimizer()
    localizer = _localizer(optimizer=optimizer)
    start, step_ns = 10**13, 10**8
    localizer.set_prior(PosePrior(NADIR, np.eye(6), start, np.array([10.0, 0.0, 0.0])))
    anchors = localizer.make_reference(_prior(start)).anchors
    estimates = {}
    for k in range(1, 40):
        optimizer.true_ns = start + k * step_ns
        wrong = 10 <= k < 10 + frames
        told = optimizer.true_ns + (round(jump_s * 1e9) if wrong else 0)
        frame = Frame(np.zeros((480, 640, 3), np.uint8), told, CAMERA, k)
        estimates[k] = localizer.localize(frame, localizer.extract_query(frame), anchors)
        assert estimates[k].exposure_time_ns == told
    assert all(estimates[k].accepted for k in range(1, 10))
    assert all(estimates[k].accepted for k in range(30, 40))
    assert estimates[39].state is TrackingState.TRACKING
    state = localizer.tracker.motion
    assert state.velocity[0] == pytest.approx(10.0, abs=1.0)
    assert np.sqrt(state.covariance[0, 0]) < 0.2


def test_a_render_thread_that_fails_for_good_is_no_secret(flight):
    """Rejected frames went on with the last reference for ever, and cleared the error each time."""
    renderer = FakeRenderer()
    f = flight(_localizer(renderer))
    f.feed_until(lambda: f.estimates and f.estimates[-1].state is TrackingState.TRACKING)
    renderer.depth = 0.0  # every view from now on is outside the map
    f.feed_until(lambda: "does not meet" in f.engine.health.last_error)
    seen = len(f.estimates)
    f.feed_until(lambda: len(f.estimates) > seen + 3)
    assert "does not meet" in f.engine.health.last_error
    # A reference older than its use is refused, and the error goes on standing.
    f.sequence += 3 * 10**9 // INTERVAL_NS
    begun, errors = f.sequence, f.engine.health.errors
    f.feed_until(lambda: f.engine.health.errors > errors + 5)
    assert not any(e.accepted and e.sequence >= begun for e in f.estimates)
    assert "does not meet" in f.engine.health.last_error


def test_while_lost_a_search_finds_the_place_and_the_way_flown_confirms_it(flight):
    optimizer, searched = FakeOptimizer(), []
    elsewhere = np.array([300.0, 0.0, 0.0])

    def search(frame, is_idle):
        searched.append(threading.current_thread().name)
        if is_idle() or np.linalg.norm(optimizer.offset) < 100.0:
            return None
        pose = Pose(NADIR.rotation, NADIR.translation + elsewhere)
        return PosePrior(pose, np.eye(6), frame.exposure_time_ns, independent=False)

    f = flight(_localizer(optimizer=optimizer), searcher=search)
    f.feed_until(lambda: f.estimates and f.estimates[-1].state is TrackingState.TRACKING)
    assert not searched
    f.provider = lambda _: None
    optimizer.offset = elsewhere  # the vehicle is 300 m off at once: every frame is refused
    f.feed_until(lambda: f.estimates[-1].state is TrackingState.LOST)
    f.feed_until(lambda: f.engine.health.found > 0)
    f.feed_until(lambda: f.localizer.tracker.track_status.tentative_track is not None)
    last = f.estimates[-1]
    assert last.state is TrackingState.LOST
    assert not last.accepted
    for step in range(12):  # it flies on, and the map goes on matching
        optimizer.offset = elsewhere + np.array([0.6 * step, 0.0, 0.0])
        count = len(f.estimates)
        f.feed_until(lambda count=count: len(f.estimates) > count + 1)
    f.feed_until(lambda: f.estimates[-1].state is TrackingState.TRACKING)
    assert f.estimates[-1].accepted
    assert set(searched) == {"search"}
    assert f.engine.health.searches >= f.engine.health.found > 0


def test_a_place_found_for_a_loss_that_is_over_is_not_tried_at_the_next_one(flight, monkeypatch):
    optimizer, answer, offered = FakeOptimizer(), threading.Event(), []
    offer = Localizer.offer
    monkeypatch.setattr(
        Localizer, "offer", lambda self, prior: (offered.append(prior.time_ns), offer(self, prior))
    )

    def search(frame, _is_idle):
        answer.wait(60.0)
        stale = frame.exposure_time_ns if f.engine.health.found == 0 else None
        return None if stale is None else PosePrior(NADIR, np.eye(6), -stale, independent=False)

    f = flight(_localizer(optimizer=optimizer), searcher=search)
    f.feed_until(lambda: f.estimates and f.estimates[-1].state is TrackingState.TRACKING)
    optimizer.offset = np.array([300.0, 0.0, 0.0])
    f.feed_until(lambda: f.engine.health.searching)
    optimizer.offset = np.zeros(3)  # it is where the prior says, after all
    f.feed_until(lambda: f.estimates[-1].state is TrackingState.TRACKING)
    answer.set()
    f.feed_until(lambda: f.engine.health.found == 1)
    fed = f.sequence
    f.feed_until(lambda: f.sequence > fed + 3)
    optimizer.offset = np.array([300.0, 0.0, 0.0])
    f.feed_until(lambda: f.engine.health.searches > 1)
    assert not any(time_ns < 0 for time_ns in offered)


def test_beside_a_search_fewer_frames_are_tried_until_it_answers(flight):
    optimizer, answer = FakeOptimizer(), threading.Event()

    def search(_frame, _is_idle):
        answer.wait(60.0)

    f = flight(_localizer(optimizer=optimizer), searcher=search)
    f.feed_until(lambda: f.estimates and f.estimates[-1].state is TrackingState.TRACKING)
    optimizer.offset = np.array([300.0, 0.0, 0.0])
    f.feed_until(lambda: f.engine.health.searching)
    tried, fed = len(f.estimates), f.sequence
    f.feed_until(lambda: f.sequence == fed + 12)
    assert len(f.estimates) - tried == 4
    optimizer.offset = np.zeros(3)  # it is where the prior says, after all: that is seen, too
    f.feed_until(lambda: f.estimates[-1].accepted)
    answer.set()
    f.feed_until(lambda: not f.engine.health.searching)
    f.feed_until(lambda: f.estimates[-1].state is TrackingState.TRACKING)


def test_a_search_that_goes_on_for_long_does_not_hang(flight):
    """Of a hundred square kilometres it takes minutes."""
    now_ns, polled, answer = [0], threading.Event(), threading.Event()

    def search(_frame, is_idle):
        while not answer.is_set() and not is_idle():
            polled.set()
            answer.wait(1e-3)

    optimizer = FakeOptimizer()
    f = flight(_localizer(optimizer=optimizer), searcher=search, clock=lambda: now_ns[0])
    f.feed_until(lambda: f.estimates and f.estimates[-1].state is TrackingState.TRACKING)
    optimizer.offset = np.array([300.0, 0.0, 0.0])
    f.feed_until(lambda: f.engine.health.searching)
    for _ in range(4):
        now_ns[0] += 100 * 10**9
        polled.clear()
        assert polled.wait(60.0)
        fed = f.sequence
        f.feed_until(lambda fed=fed: f.sequence == fed + 2)
        assert not f.engine.health.search_hangs
    answer.set()


def test_a_search_that_never_answers_is_told_and_keeps_no_frame_and_no_end_waiting(
    flight, monkeypatch, caplog
):
    optimizer, answer, now_ns = FakeOptimizer(), threading.Event(), [0]
    monkeypatch.setattr("localizer.tracking.engine._STOP_S", 0.01)

    def search(_frame, _is_idle):
        answer.wait()

    f = flight(_localizer(optimizer=optimizer), searcher=search, clock=lambda: now_ns[0])
    f.feed_until(lambda: f.estimates and f.estimates[-1].state is TrackingState.TRACKING)
    optimizer.offset = np.array([300.0, 0.0, 0.0])
    f.feed_until(lambda: f.engine.health.searching)
    now_ns[0] = 100 * 10**9  # a whole map on a slow computer
    fed = f.sequence
    f.feed_until(lambda: f.sequence == fed + 3)
    assert not f.engine.health.search_hangs
    now_ns[0] = 121 * 10**9
    f.feed_until(lambda: f.engine.health.search_hangs)
    tried, fed = len(f.estimates), f.sequence
    f.feed_until(lambda: f.sequence == fed + 6)
    assert len(f.estimates) - tried == 6
    assert caplog.text.count("the search for a place does not answer") == 1
    optimizer.offset = np.zeros(3)
    f.feed_until(lambda: f.estimates[-1].state is TrackingState.TRACKING)
    f.engine.stop()
    assert not threads()
    answer.set()
    f.engine.stop()
    assert not f.engine.health.search_hangs
