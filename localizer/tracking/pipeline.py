"""The algorithm for one frame, without threads, in the two halves that the engine runs.

`Localizer.make_reference` is the render thread's half (predict, render, extract, anchors),
`Localizer.localize` the localization thread's (extract, register, judge, filter).
`Localizer.track` is both, one after the other.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.config import LocalizerConfig
from localizer.errors import (
    CameraError,
    GeoreferenceError,
    MapLoadingError,
    OutsideMapError,
)
from localizer.features.extractor import FeatureExtractor
from localizer.geometry.camera import Camera, with_field_of_view
from localizer.geometry.geo import LocalFrame
from localizer.integrity.probability import log_odds
from localizer.map.kind import MapKind
from localizer.odometry.ground import TerrainModel
from localizer.pictures import shrink
from localizer.registration.anchors import apply_sweep, select_anchors
from localizer.registration.calibration import calibration_covariance
from localizer.registration.jngo import JNGO
from localizer.registration.result import Registration
from localizer.render.base import MapRenderer
from localizer.render.holes import fill_holes
from localizer.tracking.attitude_bias import AttitudeBias
from localizer.tracking.dead_reckoning import DeadReckoning
from localizer.tracking.motion import AuxiliarySensors, MotionState
from localizer.tracking.reference import is_still_valid, lead_share
from localizer.tracking.sensor_fusion import SensorFusion, distance_m
from localizer.tracking.tracker import Tracker, TrackerState
from localizer.types import (
    Anchors,
    FeaturePyramid,
    Frame,
    GroundUncertainty,
    Image,
    PoseEstimate,
    PosePrior,
    ReferenceBundle,
    RegistrationStatus,
    RenderedView,
    TrackingState,
)

# The map is loaded for where the motion model leads in so many seconds: what comes next, and as far
# as a turn rate can be believed at all.
_LOOK_AHEAD_S = (1.0, 3.0)

# The longest time that a reference is rendered ahead of the frame that it is made for.
_LEAD_NS = 200_000_000

_SHIFT_WIDTH = 320  # of the image that `reference_shift_px` is given for, px

# A reference view with less of the map in it than this has nothing to register against.
_MIN_MAP_SHARE = 0.1
_BESIDE_PX = 6  # of a picture's edge, working px: features there have seen what lies beyond it
_NEARLY_ALL, _WHOLLY = 0.9, 0.999  # an ordinary lens leaves its corners black

_NO_PRIOR = "no pose prior yet: call set_prior before localizing"


def working_camera(camera: Camera, width: int) -> Camera:
    """The ideal pinhole at the network's input size: `width` wide, both sides divisible by 8."""
    w = max(8, round(width / 8) * 8)
    h = max(8, round(w * camera.height / camera.width / 8) * 8)
    return camera.without_distortion().resized(w, h)


class Undistorter:
    """Converts frames of a (distorted) camera to the working pinhole's images."""

    def __init__(self, source: Camera, target: Camera) -> None:
        self.source, self._target = source, target
        self._middle, size = source, (source.width, source.height)
        # Shrinking by more than 2 under bilinear sampling aliases: average before and after the
        # undistortion, halves and whole numbers of pixels, as `shrink` does fastest.
        if source.width > 2 * target.width:
            while self._middle.width >= 4 * target.width:
                self._middle = source.resized(self._middle.width // 2, self._middle.height // 2)
            whole = round(self._middle.width / target.width)
            size = (whole * target.width, whole * target.height)
        pinhole = target.resized(*size)
        bent = not self._middle.is_like(pinhole)  # by its lens, or by its zoom
        self._maps = None
        if bent:  # OpenCV 5 is twice as fast with float32 maps and four channels as with three
            maps = self._middle.undistortion_maps(pinhole)
            self._maps = cv2.convertMaps(*maps, cv2.CV_32FC1)
        self.seen = self._seen()
        """(height, width) of the target, what the source shows of it with room to all sides; None
        where that is nearly all.
        """

    def _seen(self) -> NDArray[np.bool_] | None:
        if self._maps is None:
            return None
        white = np.full((self._middle.height, self._middle.width), 255, np.uint8)
        size = (self._target.width, self._target.height)
        shown = cv2.resize(cv2.remap(white, *self._maps, cv2.INTER_LINEAR), size)
        side = 2 * _BESIDE_PX + 1
        inside = cv2.erode(shown, np.ones((side, side), np.uint8), borderValue=255) == 255
        return inside if inside.mean() < _NEARLY_ALL else None

    def __call__(self, frame: Frame) -> Image:
        """The frame's image (height, width, 3) uint8 at the target's size. `CameraError` if the
        image has not the source camera's size.
        """
        height, width = frame.image.shape[:2]
        if (width, height) != (self.source.width, self.source.height):
            raise CameraError(
                f"frame {frame.sequence} is {width}x{height}, the camera model says "
                f"{self.source.width}x{self.source.height}: give this stream's calibration"
            )
        image = shrink(frame.image, (self._middle.width, self._middle.height))
        size = self._target.width, self._target.height
        if self._maps is None:
            return shrink(image, size)
        four = cv2.cvtColor(image, cv2.COLOR_RGB2RGBA)
        straight = np.asarray(cv2.remap(four, *self._maps, cv2.INTER_LINEAR), np.uint8)
        return np.asarray(cv2.cvtColor(shrink(straight, size), cv2.COLOR_RGBA2RGB), np.uint8)


def mask_unseen_features(pyramid: FeaturePyramid, seen: NDArray[np.bool_] | None) -> FeaturePyramid:
    """The features with zero confidence outside `seen` (H, W), the lens's image circle, where
    anchors would otherwise be compared with black. seen None: unchanged.
    """
    if seen is None:
        return pyramid
    levels = []
    for level in pyramid.levels:
        size = (level.confidence.shape[1], level.confidence.shape[0])
        share = cv2.resize(seen.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        confidence = np.where(share > _WHOLLY, level.confidence, 0).astype(np.float32)
        levels.append(replace(level, confidence=confidence))
    return replace(pyramid, levels=tuple(levels))


def reference_anchors(
    view: RenderedView, extractor: FeatureExtractor, count: int, seed: int
) -> Anchors:
    """At most `count` geo-anchors of a rendered view, the map's holes painted over (Eq. 1)."""
    return select_anchors(view, extractor.extract(fill_holes(view)), count, seed)


class Localizer:
    """The algorithm for one camera. `open_localizer` makes one; `set_prior`, then `track` frames.

    `make_reference` and `localize` may run on two threads, as in the engine.

    Above 200 lines and 15 public methods: it is the library's whole interface for one camera.
    Motion, acceptance and dead reckoning are `Tracker`'s.

    sensors: attitude and motion of autopilot and gimbal. Their rotations replace the constant
    angular rate of the motion model. Their roll, pitch and height are fused with each registration
    (`tracking.sensor_fusion`). With the displacement they confirm or refute a tentative track.
    map_frame, map_kind: the map's. terrain: ground heights outside the map; ground: uncertainty of
    the ground, that of hills by default. on_close: releases what was opened for this localizer.
    is_loading: whether the latest view lacked tiles that were being read.
    """

    def __init__(  # noqa: PLR0913
        self,
        renderer: MapRenderer,
        extractor: FeatureExtractor,
        optimizer: JNGO,
        camera: Camera,
        config: LocalizerConfig,
        sensors: AuxiliarySensors | None = None,
        *,
        map_frame: LocalFrame | None = None,
        map_kind: MapKind | None = None,
        terrain: TerrainModel | None = None,
        ground: GroundUncertainty | None = None,
        on_close: Callable[[], None] = lambda: None,
        is_loading: Callable[[], bool] = lambda: False,
    ) -> None:
        self._is_loading = is_loading
        self._map_frame, self._on_close = map_frame, on_close
        self.map_kind = map_kind
        """What the map can show; None where the localizer was made without it."""
        self._renderer = renderer
        self._extractor = extractor
        self._optimizer = optimizer
        self._config = config
        self._sensors = sensors or AuxiliarySensors()
        self._pinhole = working_camera(camera, config.width)
        self.camera = self._pinhole
        """The working pinhole of the newest frame: another where its lens has zoomed."""
        self._undistorter = Undistorter(camera, self.camera)
        self._reference: ReferenceBundle | None = None  # the last one of `track`
        self._asked_ns = 0  # what time the last reference was asked for
        self._fitted_ns: int | None = None  # of the last picture whose focal length was fitted
        self._fusion = SensorFusion(config.attitude, config.height_sigma_m, self._sensors, map_kind)
        self._tracker = Tracker(
            config, self._sensors, self._dead_reckoning(config, optimizer, terrain, ground)
        )

    def _dead_reckoning(
        self,
        config: LocalizerConfig,
        optimizer: JNGO,
        terrain: TerrainModel | None,
        ground: GroundUncertainty | None,
    ) -> DeadReckoning | None:
        if config.odometry is None:
            return None
        return DeadReckoning(
            self._pinhole,
            optimizer,
            config.odometry,
            config.threads,
            self._sensors,
            terrain,
            ground,
        )

    def __enter__(self) -> Localizer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release what `open_localizer` opened: the renderer and the map's loader thread."""
        self._on_close()

    @property
    def frame(self) -> LocalFrame:
        """The map's ENU frame, in which poses are given: to and from WGS84. `GeoreferenceError` if
        the localizer was made without it.
        """
        if self._map_frame is None:
            raise GeoreferenceError("this localizer was made without its map's frame")
        return self._map_frame

    @property
    def features_name(self) -> str:
        """Name of the feature model and what runs it."""
        return self._extractor.name

    @property
    def optimizer_name(self) -> str:
        """Name of the active backend, for reports; if a GPU fails, the CPU takes over."""
        return self._optimizer.backend.name

    @property
    def tracker(self) -> TrackerState:
        """The current motion state and track status."""
        return self._tracker.state

    @property
    def attitude_bias(self) -> AttitudeBias | None:
        """Estimated bias of the other sensors' roll and pitch; None if they are not used."""
        return self._fusion.attitude_bias.bias

    @property
    def reference_age_s(self) -> float:
        """Largest usable age of a reference view, seconds."""
        return self._config.integrity.reference_age_s

    @property
    def renderer_name(self) -> str:
        """Which renderer draws the references."""
        return self._renderer.name

    def set_prior(self, prior: PosePrior) -> None:
        """Start (again) from an external pose, for example the autopilot's: the state becomes
        INITIALIZING, and the motion is the prior's.
        """
        self._tracker.set_prior(prior)

    def offer(self, prior: PosePrior) -> None:
        """Take an external pose. Before the first fix an independent one starts the tracking; any
        other starts a tentative track (`propose`).
        """
        begins = self.tracker.track_status.state is TrackingState.INITIALIZING
        if prior.independent and begins:
            self.set_prior(prior)
        else:
            self.propose(prior)

    def propose(self, prior: PosePrior) -> None:
        """Start a tentative track; its pose is used once confirmed (`localizer.integrity`).

        The motion is the prior's from now on. The state does not change: a tentative track does not
        end LOST.
        """
        self._tracker.propose(prior)

    def track(
        self,
        frame: Frame,
        *,
        passes: int = 1,
        query: Callable[[], FeaturePyramid] | None = None,
    ) -> PoseEstimate:
        """Localize one frame on this thread: predict, render the reference, extract, register.
        Waits until the map's tiles in view are read.

        passes: number of renderings and registrations, each from the last result; use 3 for a prior
        that is metres and degrees off. query: returns the frame's features (`extract_query`) if
        they are computed in parallel. Raises `OutsideMapError` without a prior (`set_prior`), or if
        the predicted view does not meet the map, and `CameraError` if the image has not its
        camera's size.
        """
        stage_ms: dict[str, float] = {}
        features: FeaturePyramid | None = None
        least_odds = np.inf
        self.camera = with_field_of_view(self._pinhole, frame.camera)
        for remaining in range(passes - 1, -1, -1):
            prior = self.predict(frame.exposure_time_ns)
            if prior is None:
                raise OutsideMapError(_NO_PRIOR)
            with stopwatch(stage_ms, "reference"):
                last = self._reference if passes == 1 else None
                bundle = self._reference = self.reference_for(prior, last, wait=True)
            if features is None:
                with stopwatch(stage_ms, "extract"):
                    features = query() if query is not None else self.extract_query(frame)
            if remaining:
                found = self._register_again(frame, features, bundle.anchors, prior)
                least_odds = float(np.minimum(least_odds, log_odds(found)))  # keeps a NaN
                continue
            estimate = self.localize(frame, features, bundle.anchors, earlier_log_odds=least_odds)
        return replace(estimate, stage_ms=stage_ms | estimate.stage_ms)

    def _register_again(
        self, frame: Frame, features: FeaturePyramid, anchors: Anchors, prior: PosePrior
    ) -> Registration:
        """Register, then make the result the prior. Sigma only halves: the same image is no new
        evidence.
        """
        seen = self.tracker
        ahead = self._ahead(seen, frame)
        image = self._register(
            frame, features, self._apply_sweep(anchors, frame, ahead), seen, ahead
        )
        found = self._fusion.fuse(image, frame.exposure_time_ns).registration
        if found.status is RegistrationStatus.OK:
            self.set_prior(PosePrior(found.world_from_camera, prior.covariance / 4, prior.time_ns))
        return found

    def predict(self, time_ns: int) -> PosePrior | None:
        """The motion model's prediction at `time_ns`; None before the first prior."""
        return self._tracker.predict(time_ns)

    def reference_for(
        self, prior: PosePrior, last: ReferenceBundle | None, *, wait: bool = False
    ) -> ReferenceBundle:
        """`last` while it is usable (`reference_shift_px`), otherwise a new one (`make_reference`),
        which may be rendered up to 0.2 s ahead of the prior. last: None before the first. wait, and
        errors: as `make_reference`.
        """
        track_status = self.tracker.track_status
        holds = track_status.state is TrackingState.TRACKING and track_status.rejected_in_row == 0
        steady = holds and not self._is_loading()
        shift_px = self._config.reference_shift_px * self.camera.width / _SHIFT_WIDTH
        pose, time_ns = prior.world_from_camera, prior.time_ns
        interval_ns, self._asked_ns = time_ns - self._asked_ns, time_ns
        if last is None or not steady or shift_px == 0:
            return self.make_reference(prior, wait=wait)
        if is_still_valid(last, pose, self.camera, time_ns, shift_px):
            return last
        later = self.predict(time_ns + _LEAD_NS)
        if later is not None:
            frame = abs(interval_ns) / _LEAD_NS
            share = lead_share(last, pose, later.world_from_camera, shift_px, frame)
            later = self.predict(time_ns + round(share * _LEAD_NS)) if share else None
        return self.make_reference(prior, at=later, wait=wait)

    def make_reference(
        self, prior: PosePrior, *, at: PosePrior | None = None, wait: bool = False
    ) -> ReferenceBundle:
        """Render the view at the prior's pose and select its geo-anchors (paper, Eq. 1 and 2).

        at: a later pose of the camera, if the view is to be rendered there; the bundle keeps the
        time of `prior`. wait: block until all tiles in view are read. If the map covers less than
        10 % of the view's pixels, `MapLoadingError` is raised while tiles are being read and `wait`
        is false, otherwise `OutsideMapError`.
        """
        pose = (at or prior).world_from_camera
        view = self._renderer.render(pose, self.camera, wait=wait)
        if np.count_nonzero(view.depth) < _MIN_MAP_SHARE * view.depth.size:
            if not wait and self._is_loading():
                raise MapLoadingError("the map is being loaded")
            e, n, u = pose.translation
            raise OutsideMapError(
                f"the view from east {e:.1f} north {n:.1f} up {u:.1f} m (map frame) does not meet "
                "the map, as far as it is loaded: if it stays so, check the prior, the map's "
                "extent and the camera's direction"
            )
        anchors = reference_anchors(view, self._extractor, self._config.anchors, self._config.seed)
        return ReferenceBundle(view, anchors, prior.time_ns)

    def prefetch(self, time_ns: int) -> None:
        """Load the map along the predicted trajectory after `time_ns`; returns immediately."""
        times = [time_ns + round(s * 1e9) for s in _LOOK_AHEAD_S]
        ahead = [prior for t in times if (prior := self.predict(t)) is not None]
        self._renderer.prefetch([prior.world_from_camera for prior in ahead], self.camera)

    def extract_query(self, frame: Frame) -> FeaturePyramid:
        """Features of the frame, undistorted. They do not need the reference, so this may run in
        parallel, on one thread at a time: it sets `camera`, and adapts to another lens or zoom.
        `CameraError` if the image has not its camera's size.
        """
        undistorter, camera = self._undistorter, with_field_of_view(self._pinhole, frame.camera)
        self.camera = camera
        if not frame.camera.is_like(undistorter.source):  # another size in flight, or a zoom
            undistorter = self._undistorter = Undistorter(frame.camera, camera)
        return mask_unseen_features(self._extractor.extract(undistorter(frame)), undistorter.seen)

    def _ahead(self, seen: TrackerState, frame: Frame) -> MotionState:
        ahead = self._tracker.at_frame(seen, frame.exposure_time_ns)
        if ahead is None:
            raise OutsideMapError(_NO_PRIOR)
        return ahead

    def _apply_sweep(self, anchors: Anchors, frame: Frame, ahead: MotionState) -> Anchors:
        """The anchors as the rows of a rolling shutter see them."""
        about = ahead.prior.world_from_camera
        return apply_sweep(anchors, self._tracker.sweep(frame, ahead), about, frame.camera)

    def _register(
        self, frame: Frame, query: FeaturePyramid, anchors: Anchors, seen: TrackerState,
        ahead: MotionState,
    ) -> Registration:  # fmt: skip
        camera = with_field_of_view(self._pinhole, frame.camera)
        image = self._optimizer.register(
            query,
            camera,
            anchors,
            ahead.prior,
            motion=ahead.prior if seen.track_status.trusts_prediction else None,
            seed=self._config.seed + frame.sequence,
        )
        if seen.track_status.tentative and not seen.track_status.independent:
            image = self._optimizer.with_focal_gain(query, camera, anchors, image)
        return image

    def localize(
        self,
        frame: Frame,
        query: FeaturePyramid,
        anchors: Anchors | None,
        *,
        earlier_log_odds: float = np.inf,
    ) -> PoseEstimate:
        """Register the frame against the anchors, test the result and update the filter.

        anchors: None without a reference; the odometry then estimates the pose, if it can.
        earlier_log_odds: as `Registration`'s. `OutsideMapError` before there is a prior.
        """
        seen = self.tracker
        ahead = self._ahead(seen, frame)
        stage_ms: dict[str, float] = {}
        camera = with_field_of_view(self._pinhole, frame.camera)
        result, image, sweep = None, None, self._tracker.sweep(frame, ahead)
        if anchors is not None:
            with stopwatch(stage_ms, "register"):
                seen_anchors = self._apply_sweep(anchors, frame, ahead)
                image = self._register(frame, query, seen_anchors, seen, ahead)
                image = replace(image, earlier_log_odds=earlier_log_odds)
                result = self._fusion.fuse(image, frame.exposure_time_ns)
        estimate = self._tracker.update(seen, ahead, frame, query, anchors, result)
        if anchors is not None and image is not None and estimate.status is RegistrationStatus.OK:
            # Added to what is reported, not to what is filtered: the next frame has the same error.
            moving = (ahead.velocity, ahead.rate)
            unknown = calibration_covariance(
                self._config.calibration, anchors.points_world, estimate.world_from_camera,
                camera, sweep, moving,
            )  # fmt: skip
            estimate = replace(estimate, covariance=estimate.covariance + unknown)
            if estimate.accepted and estimate.state is TrackingState.TRACKING:
                pose = estimate.world_from_camera
                away_m = distance_m(anchors.points_world, pose.translation)
                self._fusion.learn(image, pose, unknown, away_m, frame.exposure_time_ns)
            if self._is_focal_due(estimate):
                focal = self._optimizer.fit_focal(query, camera, seen_anchors, image)
                estimate = replace(estimate, focal=focal)
        return replace(estimate, stage_ms=stage_ms)

    def _is_focal_due(self, estimate: PoseEstimate) -> bool:
        """Whether this frame's focal length is to be fitted."""
        every_ns = round(1e9 * self._config.focal_fit_s)
        if not every_ns or not estimate.accepted or estimate.state is not TrackingState.TRACKING:
            return False
        now_ns, last_ns = estimate.exposure_time_ns, self._fitted_ns
        if last_ns is not None and 0 <= now_ns - last_ns < every_ns:
            return False
        self._fitted_ns = now_ns
        return True


@contextmanager
def stopwatch(stage_ms: dict[str, float], stage: str) -> Iterator[None]:
    """Add the milliseconds spent inside to ``stage_ms[stage]``."""
    started = time.perf_counter()
    try:
        yield
    finally:
        stage_ms[stage] = stage_ms.get(stage, 0.0) + (time.perf_counter() - started) * 1e3
