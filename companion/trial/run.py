"""Runs a trial: localize with telemetry, estimate corrections, repeat, search, find reasons."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from companion.errors import StreamDecodeError
from companion.offline.localize import sensors_of
from companion.recorded.flight import RecordedFlight, RecordedFrame
from companion.sources.folder_source import read_image
from companion.trial.estimate import Estimated, EstimateTools, estimate
from companion.trial.localize import FrameLocalizer, Localized, horizontal_m
from companion.trial.priors import FlightPriors, FramePrior, priors_of
from companion.trial.result import Trial
from localizer.config import LocalizerConfig
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.inspection.kind import map_kind
from localizer.map.kind import MapKind
from localizer.relocalization.relocalizer import Relocalizer, open_relocalizer
from localizer.tracking.attitude_bias import AttitudePrior
from localizer.tracking.opening import MapStack, build_localizer
from localizer.types import Image

_WIDTH_PX = 640
_BRIGHT, _DARK, _SHARE = 250, 12, 0.3
_LEAST_CONTRAST = 8.0  # grey levels
_BLURRED = 0.25  # of the footage's median sharpness
_FAR_SIGMAS = 4.0


@dataclass(frozen=True)
class ImageState:
    """bright, dark: shares of white and of black pixels; contrast: standard deviation, grey levels;
    sharpness: variance of the Laplacian at 640 px width.
    """

    bright: float
    dark: float
    contrast: float
    sharpness: float


def image_state(image: Image) -> ImageState:
    """Image quality of an RGB image (H, W, 3)."""
    height = round(image.shape[0] * _WIDTH_PX / image.shape[1])
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return ImageState(
        float((grey >= _BRIGHT).mean()), float((grey <= _DARK).mean()), float(grey.std()),
        float(cv2.Laplacian(grey, cv2.CV_32F).var()),
    )  # fmt: skip


def image_states(frames: Sequence[RecordedFrame]) -> list[ImageState | None]:
    """Image quality of each frame; None if it cannot be read."""
    found: list[ImageState | None] = []
    for one in frames:
        try:
            found.append(image_state(read_image(one.path)))
        except (StreamDecodeError, OSError):
            found.append(None)
    return found


def reasons(
    frames: Sequence[RecordedFrame],
    priors: Sequence[FramePrior],
    localized: Sequence[Localized],
    estimated: Estimated | None,
    kind: MapKind | None = None,
) -> dict[int, str]:
    """Likely reason by frame number, for each frame that was not accepted; reads all images if one
    was not. kind: of the map, None if unknown.
    """
    failed = [k for k, one in enumerate(localized) if not one.accepted]
    if not failed:
        return {}
    states = image_states(frames)
    sharp = [s.sharpness for s in states if s is not None]
    usual = float(np.median(sharp)) if sharp else 0.0
    return {
        k: _image_reason(states[k], usual)
        or _place_reason(priors[k], localized[k])
        or _setup_reason(estimated)
        or map_reason(kind)
        for k in failed
    }  # fmt: skip


def _image_reason(state: ImageState | None, usual_sharpness: float) -> str:
    if state is None:
        return "the image cannot be read"
    if state.bright > _SHARE:
        return f"over-exposed: {100 * state.bright:.0f} % of the image is white"
    if state.dark > 1.5 * _SHARE:
        return f"too dark: {100 * state.dark:.0f} % of the image is black"
    if state.contrast < _LEAST_CONTRAST:
        return "no contrast: haze, cloud or a covered lens"
    if state.sharpness < _BLURRED * usual_sharpness:
        return "blurred, against the other images"
    return ""


def _place_reason(prior: FramePrior, one: Localized) -> str:
    if prior.pose is None and not one.searched:
        return "no position was recorded"
    if prior.pose is not None and not prior.over_map:
        return "no map: it was taken beside the map"
    if one.searched:
        unknown = [
            name
            for name, known in (
                ("heading", prior.heading_sigma_deg is not None), ("height", prior.height_known)
            )
            if not known
        ]  # fmt: skip
        return (
            f"not found about its position: {' and '.join(unknown)} unknown, or a map of another "
            "place or date"
        )
    if one.beside_map:
        return "no map in view: the camera's direction or height is wrong, or the map ends there"
    if one.pose is not None and prior.pose is not None and prior.is_complete:
        away_m = horizontal_m(one.pose, prior.pose)
        if away_m > _FAR_SIGMAS * max(prior.sigma_m, 0.05 * prior.clearance_m):
            return (
                f"registered {away_m:.0f} m from its recorded position, which says "
                f"{prior.sigma_m:.0f} m: position, height or angles are wrong"
            )
    return ""


def map_reason(kind: MapKind | None) -> str:
    """Reason by the map: why a good image at the right position fails. kind: None if unknown."""
    if kind is not None and not kind.has_buildings:
        what = "flat" if kind.heights == "flat" else "bare terrain"
        return f"the map is {what} without buildings and trees; use a surface model, which has them"
    return "image and map agree too little: a map of another season, date or sensor"


def _setup_reason(estimated: Estimated | None) -> str:
    """Reason if too few frames agree, so that none can be named; otherwise ""."""
    if estimated is not None:
        return ""
    return (
        "too few frames agree to tell: the map's place, the focal length, the camera's angles or "
        "the map's age"
    )


Count = Callable[[int, int], None]
Stage = Callable[[str], AbstractContextManager[Count]]
# Parts of a picture are found to a share of a pixel, and that error grows with the pixel: at 320 px
# it bends the focal length of a near-nadir flight by 1 %. Pixels finer than the map's imagery err
# more again: over a satellite mosaic the gimbal's bias is 1.5 degrees off then.
_MEASURED_WIDTH = 640
_MOST_PLACED = 24  # frames that are searched about their position: each takes 10 to 40 s
_VAIN = 6  # searches without a result, after which the others of their kind are not tried
_AGAIN_M, _AGAIN_DEG = 2.0, 2.0  # about a place that was searched and found


def run_trial(
    flight: RecordedFlight,
    map_cache: Path,
    width: int = 320,
    searches: int = 20,
    stage: Stage = lambda _what: nullcontext(lambda _done, _total: None),
) -> Trial:
    """Localize the footage over the map. width: of the image registered, pixels; searches: frames
    also searched without position; stage(name): context manager that gives a function for progress
    (frames done, in all).

    Raises named errors for a map or footage that cannot be used.
    """
    config = LocalizerConfig(width=width, feature_threads=2)
    with ExitStack() as opened:
        stack = MapStack(map_cache, config)
        opened.callback(stack.close)
        known = priors_of(flight, stack.cache)
        kind = map_kind(stack.cache)
        search = _lazy_relocalizer(stack.cache, config, opened)
        first_loader = FrameLocalizer(
            build_localizer(stack, flight.camera.camera, config), search, flight.camera.camera
        )
        flight, known, first = localize_from_telemetry(flight, known, first_loader, stage)
        extractor = DetailExtractor(load_extractor(None, threads=2))
        measured = _measured_width(flight.camera.camera, known.priors, kind, width)
        tools = EstimateTools(stack.renderer, extractor, measured, kind.has_buildings)
        with stage("estimating camera and map offset") as count:
            found = estimate(
                flight.frames, known.priors, first, flight.camera, tools, first_loader, count
            )
        priors, second, loader = known.priors, first, first_loader
        if found is not None:
            priors = tuple(found.correction.applied(p) for p in known.priors)
            started = tuple(map(_prior_from_search, priors, first))
            recorded_poses: dict[int, Pose] = {}
            sure = build_localizer(
                stack, found.camera, _corrected_config(config, started), sensors_of(recorded_poses)
            )
            loader = FrameLocalizer(sure, search, found.camera, recorded_poses)
            second = tuple(
                localize_each(
                    range(len(started)), (),
                    lambda k: loader.from_prior(flight.frames[k], started[k]),
                    stage("localizing again"),
                ).values()
            )  # fmt: skip
        searched, left = _searched(flight, priors, loader, searches, stage)
    notes = (*flight.notes, *known.notes, *left, *_map_notes(kind, flight))
    trial = Trial(flight, priors, first, second, searched, found, {}, notes)
    return replace(trial, reasons=reasons(flight.frames, priors, trial.best, found, kind))


def evenly_spread(items: Sequence[int], most: int) -> list[int]:
    """At most `most` of the items. Each beginning of the result is spread over all items."""
    return [items[k] for k in sorted(range(len(items)), key=lambda k: f"{k:032b}"[::-1])][:most]


def localize_each(
    order: Sequence[int],
    searched: Collection[int],
    localize: Callable[[int], Localized],
    counter: AbstractContextManager[Count],
) -> dict[int, Localized]:
    """Localize in this order; results by frame number. If 6 frames of `searched` failed and none
    was found, its others are left out.
    """
    done: dict[int, Localized] = {}
    with counter as count:
        for k in order:
            tried = [one.accepted for j, one in done.items() if j in searched]
            if k in searched and len(tried) >= _VAIN and not any(tried):
                continue
            done[k] = localize(k)
            count(len(done), len(order))
    return done


def localize_from_telemetry(
    flight: RecordedFlight, known: FlightPriors, loader: FrameLocalizer, stage: Stage
) -> tuple[RecordedFlight, FlightPriors, tuple[Localized, ...]]:
    """Localize all frames from telemetry. A frame without heading or height needs a search; at most
    24 of them are searched, and the others are left out of all three results. A note says so.
    """
    frames, priors = flight.frames, known.priors
    slow = [k for k, p in enumerate(priors) if p.pose is not None and not p.is_complete]
    chosen = evenly_spread(slow, _MOST_PLACED)
    done = localize_each(
        [*chosen, *(k for k in range(len(priors)) if k not in slow)], chosen,
        lambda k: loader.from_prior(frames[k], priors[k]), stage("localizing"),
    )  # fmt: skip
    kept = sorted(done)
    left_out, notes = len(priors) - len(kept), known.notes
    if left_out:
        tried = len(slow) - left_out
        vain = ", and none of them is found" if tried < len(chosen) else ""
        notes = (
            *notes,
            f"{len(slow)} frames lack a heading or a usable height and would each be searched "
            f"about their position: {tried} of them, spread over the flight, stand for all{vain}; "
            f"{left_out} are not tried",
        )
    return (
        replace(flight, frames=tuple(frames[k] for k in kept)),
        replace(known, priors=tuple(priors[k] for k in kept), notes=notes),
        tuple(done[k] for k in kept),
    )


def _corrected_config(config: LocalizerConfig, priors: tuple[FramePrior, ...]) -> LocalizerConfig:
    """Settings with the median sigmas of the corrected tilt and height: over flat ground a tilt of
    the camera and a shift of its position look alike.
    """
    tilt_deg = float(np.median([p.tilt_sigma_deg for p in priors]))
    height_m = float(np.median([p.height_sigma_m for p in priors]))
    attitude = AttitudePrior.with_sigma(tilt_deg)
    return config.model_copy(update={"attitude": attitude, "height_sigma_m": height_m})


def _measured_width(
    camera: Camera, priors: tuple[FramePrior, ...], kind: MapKind, least: int
) -> int:
    """Image width for the estimate, pixels: as fine as the map's imagery, in bounds."""
    most = max(least, min(_MEASURED_WIDTH, camera.width))
    ground_m = float(np.median([p.clearance_m for p in priors])) * camera.width / camera.fx
    return int(np.clip(ground_m / max(kind.effective_resolution_m, 1e-3), least, most))


def _map_notes(kind: MapKind, flight: RecordedFlight) -> tuple[str, ...]:
    advice = kind.advice(flight.camera.camera.horizontal_fov_deg / 2)
    return (f"map: {kind.line()}", *([advice] if advice else []))


def _lazy_relocalizer(
    cache: TileCache, config: LocalizerConfig, opened: ExitStack
) -> Callable[[], Relocalizer]:
    """A function that opens the relocalizer at its first call: it computes the map's overview."""
    relocalization = replace(config.relocalization, threads=2)

    @functools.cache
    def relocalizer() -> Relocalizer:
        made = open_relocalizer(cache, config.model_copy(update={"relocalization": relocalization}))
        assert made is not None  # only a `should_stop` gives None
        return opened.enter_context(made)

    return relocalizer


def _prior_from_search(prior: FramePrior, first: Localized) -> FramePrior:
    """Prior for the second pass: the pose where a search found the frame, otherwise unchanged."""
    if prior.is_complete or not first.accepted or first.pose is None:
        return prior
    return replace(
        prior, pose=first.pose, rotation=first.pose.rotation, sigma_m=_AGAIN_M,
        height_m=float(first.pose.translation[2]), height_sigma_m=_AGAIN_M, height_known=True,
        tilt_sigma_deg=_AGAIN_DEG, heading_sigma_deg=_AGAIN_DEG, was_searched=True,
    )  # fmt: skip


def _searched(
    flight: RecordedFlight,
    priors: tuple[FramePrior, ...],
    loader: FrameLocalizer,
    most: int,
    stage: Stage,
) -> tuple[dict[int, Localized], tuple[str, ...]]:
    """Results of frames searched without positions, and a note if some were left out."""
    chosen = evenly_spread(range(len(priors)), most)
    if not chosen:
        return {}, ()
    found = localize_each(
        chosen, chosen, lambda k: loader.search_map(flight.frames[k], priors[k]),
        stage("searching without positions"),
    )  # fmt: skip
    left_out = len(chosen) - len(found)
    note = f"without positions none of {len(found)} frames is found; {left_out} are not tried"
    return found, (note,) if left_out else ()
