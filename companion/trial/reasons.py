"""Finds the likely reason why a frame was not localized, from image, map and telemetry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from companion.errors import StreamDecodeError
from companion.recorded.flight import RecordedFrame
from companion.sources.folder_source import read_image
from companion.trial.estimate import Estimated
from companion.trial.localize import Localized, horizontal_m
from companion.trial.priors import FramePrior
from localizer.map.kind import MapKind
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
