"""Localizes recorded sequences by the paper's protocol (Sec. 4.1), and its error measures."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from localizer.errors import LocalizerError, OutsideMapError, SequenceError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.pictures import read_rgb
from localizer.tracking.pipeline import Localizer
from localizer.types import Frame, PoseEstimate, PosePrior


@dataclass(frozen=True)
class LocalizationMetrics:
    """One row of the paper's Table 2. Recalls and completeness in per cent of all frames.

    Medians, 95th percentiles and maxima are over the localized frames; None if there is none.
    """

    frames: int
    median_translation_m: float | None
    median_rotation_deg: float | None
    recall_1: float
    recall_3: float
    recall_5: float
    completeness: float
    fps: float
    p95_translation_m: float | None = None
    p95_rotation_deg: float | None = None
    max_translation_m: float | None = None
    max_rotation_deg: float | None = None


def localization_metrics(
    translation_m: Array, rotation_deg: Array, seconds: float
) -> LocalizationMetrics:
    """Metrics of per-frame errors (F,); NaN marks a frame without an estimate.

    Medians are over the localized frames; a recall counts a frame when both errors are within its
    number of metres and degrees; a frame without an estimate counts as failed. seconds: wall time
    of the run.
    """
    frames = len(translation_m)
    found = np.isfinite(translation_m) & np.isfinite(rotation_deg)

    def recall(limit: float) -> float:
        within = found & (translation_m <= limit) & (rotation_deg <= limit)
        return _percent(int(np.count_nonzero(within)), frames)

    return LocalizationMetrics(
        frames=frames,
        median_translation_m=_percentile(translation_m[found], 50),
        median_rotation_deg=_percentile(rotation_deg[found], 50),
        recall_1=recall(1.0),
        recall_3=recall(3.0),
        recall_5=recall(5.0),
        completeness=_percent(int(np.count_nonzero(found)), frames),
        fps=frames / seconds if seconds > 0 else 0.0,
        p95_translation_m=_percentile(translation_m[found], 95),
        p95_rotation_deg=_percentile(rotation_deg[found], 95),
        max_translation_m=_percentile(translation_m[found], 100),
        max_rotation_deg=_percentile(rotation_deg[found], 100),
    )


def _percentile(values: Array, percent: float) -> float | None:
    if not len(values):
        return None
    # Of an even number of values np.percentile rounds differently than the mean of the two.
    return float(np.median(values) if percent == 50 else np.percentile(values, percent))


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 0.0


PriorMode = Literal["first", "each"]
# Renderings and registrations of a frame that starts from a perturbed prior, each from the last
# result.
_PASSES = 3
# (frame, its truth, its index) -> the prior to begin from, None where no place is found.
FindPlace = Callable[[Frame, Pose, int], PosePrior | None]

CSV_COLUMNS = (
    "name", "latitude_deg", "longitude_deg", "height_m", "translation_error_m",
    "rotation_error_deg", "quality", "state", "status", "accepted", "problem",
)  # fmt: skip


@dataclass(frozen=True)
class Sequence:
    """A recorded sequence: image paths in order, and the true pose of each. is_timed: whether
    exposure times were given; if not, 30 frames a second are assumed.
    """

    images: tuple[Path, ...]
    times_ns: tuple[int, ...]
    truth: tuple[Pose, ...]
    camera: Camera
    is_timed: bool = True

    def frame(self, index: int) -> Frame:
        """Decode one frame. `SequenceError` if it cannot be read or has not the camera's size."""
        rgb = read_rgb(self.images[index])
        if rgb.shape[:2] != (self.camera.height, self.camera.width):
            raise SequenceError(
                f"{self.images[index]}: is {rgb.shape[1]}x{rgb.shape[0]}, the camera model says "
                f"{self.camera.width}x{self.camera.height}: give this sequence's calibration"
            )
        return Frame(rgb, self.times_ns[index], self.camera, index)

    def first(self, count: int) -> Sequence:
        """The sequence's first `count` frames; all if there are fewer."""
        return replace(
            self,
            images=self.images[:count],
            times_ns=self.times_ns[:count],
            truth=self.truth[:count],
        )


@dataclass(frozen=True)
class EvaluatedFrame:
    """Result of one frame. Errors are None if no estimate was accepted.

    estimate: None for an image that cannot be used (`problem` says why), or while the position is
    unknown (`searching`).
    """

    name: str
    estimate: PoseEstimate | None
    translation_error_m: float | None = None
    rotation_error_deg: float | None = None
    problem: str = ""
    searching: bool = False

    @property
    def unusable(self) -> bool:
        """Whether the image itself could not be used."""
        return self.estimate is None and not self.searching


@dataclass(frozen=True)
class Perturbation:
    """Random error of a prior, up to so many metres and degrees. reported: adds simulated sensor
    data of a frame (`DrawnSensors.in_prior`).
    """

    translation_m: float = 10.0
    rotation_deg: float = 10.0
    seed: int = 0
    reported: Callable[[PosePrior, Pose, int], PosePrior] = lambda prior, _truth, _index: prior

    def prior(self, truth: Pose, index: int, time_ns: int) -> PosePrior:
        """The true pose world_from_camera of frame `index`, moved and rotated about random axes by
        uniform amounts up to the bounds, as a prior with matching covariance. The same seed and
        index give the same prior.
        """
        rng = np.random.default_rng((self.seed, index))
        offset = _random_vector(rng, self.translation_m)
        turn = _random_vector(rng, np.radians(self.rotation_deg))
        pose = Pose(so3_exp(turn) @ truth.rotation, truth.translation + offset)
        # A vector of uniform length up to a in a random direction has variance a²/9 per axis;
        # half the bound keeps the bound itself within two sigma.
        sigma = np.repeat([self.translation_m / 2, np.radians(self.rotation_deg) / 2], 3)
        prior = PosePrior(pose, np.diag(np.maximum(sigma, 1e-3) ** 2), time_ns)
        return self.reported(prior, truth, index)


def _random_vector(rng: np.random.Generator, limit: float) -> Array:
    direction = rng.standard_normal(3)
    vector: Array = direction / np.linalg.norm(direction) * rng.uniform(0.0, limit)
    return vector


def evaluate(
    localizer: Localizer,
    sequence: Sequence,
    perturbation: Perturbation,
    mode: PriorMode = "first",
    progress: Callable[[int], None] = lambda _: None,
    find: FindPlace | None = None,
) -> tuple[list[EvaluatedFrame], LocalizationMetrics]:
    """Localize every frame of a sequence and compute errors and metrics.

    mode ``first``: only the first frame has a prior, as in the paper; ``each``: every frame starts
    from its own perturbed true pose. progress: called with the index of each frame that is done.
    find: gives a prior at the start and when the camera is lost, instead of the perturbed true
    pose. A frame outside the map or with an unusable image counts as not
    localized; `OutsideMapError` or `SequenceError` if all frames are.
    """

    def begin(frame: Frame, index: int) -> bool:
        """Give the localizer a prior of the frame; False where no place is found."""
        truth = sequence.truth[index]
        if find is None:
            localizer.set_prior(perturbation.prior(truth, index, frame.exposure_time_ns))
            return True
        prior = find(frame, truth, index)
        if prior is not None:
            localizer.offer(prior)
        return prior is not None

    frames: list[EvaluatedFrame] = []
    errors: list[LocalizerError] = []
    has_prior = False
    seconds = 0.0
    with ThreadPoolExecutor(1, thread_name_prefix="query") as pool:
        for index in range(len(sequence.images)):
            try:
                frame = sequence.frame(index)
            except SequenceError as error:
                errors.append(error)
                frames.append(EvaluatedFrame(sequence.images[index].name, None, problem=str(error)))
                progress(index)
                continue
            started = time.perf_counter()
            lost = not has_prior or localizer.tracker.track_status.wants_prior
            fresh = (mode == "each" or not has_prior) if find is None else lost
            pending = pool.submit(localizer.extract_query, frame)  # beside the reference
            outcome: PoseEstimate | None = None
            for anew in (True,) if fresh else (False, True):
                if anew and not begin(frame, index):
                    break
                has_prior = True
                try:
                    outcome = localizer.track(
                        frame, passes=_PASSES if anew else 1, query=pending.result
                    )
                except OutsideMapError as error:
                    if mode == "first" and anew and find is None:
                        raise  # every other frame hangs on this prior
                    errors.append(error)
                    outcome = localizer.localize(frame, pending.result(), None)
                if find is None or not localizer.tracker.track_status.wants_prior:
                    break  # else it is searched for in the same frame
            seconds += time.perf_counter() - started
            if outcome is None:
                name = sequence.images[index].name
                frames.append(EvaluatedFrame(name, None, searching=True))
            else:
                frames.append(_measure(sequence, index, outcome))
            progress(index)
    if len(errors) == len(frames):
        raise errors[0]
    return frames, _summary(frames, seconds)


def _measure(sequence: Sequence, index: int, estimate: PoseEstimate) -> EvaluatedFrame:
    name = sequence.images[index].name
    if not estimate.accepted:
        return EvaluatedFrame(name, estimate)
    translation, rotation = sequence.truth[index].distance_to(estimate.world_from_camera)
    return EvaluatedFrame(name, estimate, translation, rotation)


def _summary(frames: list[EvaluatedFrame], seconds: float) -> LocalizationMetrics:
    """Metrics of the frames. seconds: time spent on usable images, for the frame rate."""
    translation, rotation = error_arrays(frames)
    usable = sum(not f.unusable for f in frames)
    metrics = localization_metrics(translation, rotation, seconds)
    return replace(metrics, fps=metrics.fps * usable / len(frames))


def error_arrays(frames: list[EvaluatedFrame]) -> tuple[Array, Array]:
    """Position errors (F,) in metres and rotation errors (F,) in degrees, NaN where unknown."""
    return (
        np.array([f.translation_error_m for f in frames], dtype=np.float64),
        np.array([f.rotation_error_deg for f in frames], dtype=np.float64),
    )


def worst_first(frames: list[EvaluatedFrame]) -> list[int]:
    """Indices of localized frames by decreasing position error, then of rejected frames by
    increasing quality. Unusable images are left out.
    """

    def place(index: int) -> tuple[bool, float]:
        error, estimate = frames[index].translation_error_m, frames[index].estimate
        if error is not None:
            return False, -error
        return True, 0.0 if estimate is None else estimate.quality

    return sorted((i for i, f in enumerate(frames) if f.estimate is not None), key=place)


def csv_rows(frames: list[EvaluatedFrame], frame: LocalFrame) -> Iterator[dict[str, str]]:
    """Yield one dictionary per frame for a CSV file; unknown values are ""."""
    for f in frames:
        row = dict.fromkeys(CSV_COLUMNS, "") | {"name": f.name, "problem": f.problem}
        if f.estimate is not None:
            position = frame.position(f.estimate.world_from_camera.translation)
            row |= {
                "latitude_deg": f"{position.latitude_deg:.9f}",
                "longitude_deg": f"{position.longitude_deg:.9f}",
                "height_m": f"{position.height_m:.3f}",
                "translation_error_m": _error_text(f.translation_error_m),
                "rotation_error_deg": _error_text(f.rotation_error_deg),
                "quality": f"{f.estimate.quality:.3f}",
                "state": f.estimate.state.value,
                "status": f.estimate.status.name,
                "accepted": str(int(f.estimate.accepted)),
            }
        yield row


def _error_text(error: float | None) -> str:
    return "" if error is None else f"{error:.4f}"
