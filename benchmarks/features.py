"""Features side by side: intensity, gradient, SIFT + PnP-RANSAC and the network, by condition.

    python benchmarks/features.py --pairs 60 [--model FILE.onnx ...] [--json OUT.json]

Every pair shows a generated place that no training run has seen (seeds from 5,000,000 on), its
query under its own light, weather and season. The reference is rendered 5 m and 5 deg from the
query's true pose; the direct methods go through the same `JNGO`, SIFT through PnP-RANSAC on the
rendered depth. Shares come with Wilson's 95 % intervals.

    python benchmarks/features.py --real ../shared/data/caliterra    (real photos)
    python benchmarks/features.py --real ../shared/data/quito        (real mesh, made weather)
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from feature_pairs import DEGREES, METRES, TestPair, made_pairs, mesh_pairs, real_pairs

from localizer.features import FeatureExtractor, GradientExtractor, load_extractor
from localizer.pose import Pose
from localizer.registration import JNGO, select_anchors
from localizer.synth.appearance import CONDITIONS
from localizer.types import (
    FeatureLevel,
    FeaturePyramid,
    Image,
    PosePrior,
    RenderedView,
)

Method = Callable[[RenderedView, Image, PosePrior, int], Pose]


@dataclass(frozen=True)
class Outcome:
    """One method on one pair: errors (metres, degrees) and the pair's kind."""

    method: str
    condition: str
    outdated: bool
    metres: float
    degrees: float
    seconds: float


class IntensityExtractor:
    """Locally normalised grey values at the same strides as the network."""

    name = "intensity"

    def extract(self, rgb: Image) -> FeaturePyramid:
        gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        levels = []
        for stride in (8, 4, 2):
            smooth = cv2.GaussianBlur(gray, (0, 0), 0.6 * stride)
            size = (gray.shape[1] // stride, gray.shape[0] // stride)
            small = cv2.resize(smooth, size, interpolation=cv2.INTER_AREA)
            value = 0.5 * (small - small.mean()) / (small.std() + 1e-3)
            levels.append(FeatureLevel(value[..., None], np.ones_like(value), stride))
        return FeaturePyramid(tuple(levels), rgb.shape[1], rgb.shape[0])


class Direct:
    """Feature-metric registration with one extractor."""

    def __init__(self, extractor: FeatureExtractor) -> None:
        self._extractor, self._optimizer = extractor, JNGO()

    def __call__(self, view: RenderedView, query: Image, prior: PosePrior, seed: int) -> Pose:
        anchors = select_anchors(view, self._extractor.extract(view.rgb), seed=seed)
        found = self._optimizer.register(
            self._extractor.extract(query), view.camera, anchors, prior, seed=seed
        )
        return found.world_from_camera


def sift_pnp(view: RenderedView, query: Image, prior: PosePrior, seed: int) -> Pose:
    """SIFT matches lifted by the rendered depth, then PnP in RANSAC with refinement."""
    cv2.setRNGSeed(seed)
    sift = cv2.SIFT_create(3000, contrastThreshold=0.01)
    keys_r, words_r = sift.detectAndCompute(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), None)
    keys_q, words_q = sift.detectAndCompute(cv2.cvtColor(query, cv2.COLOR_RGB2GRAY), None)
    if words_r is None or words_q is None or len(words_r) < 2:
        return prior.world_from_camera
    matches = cv2.BFMatcher().knnMatch(words_q, words_r, k=2)
    good = [m[0] for m in matches if len(m) == 2 and m[0].distance < 0.8 * m[1].distance]
    pixels_r = np.array([keys_r[m.trainIdx].pt for m in good]).reshape(-1, 2)
    pixels_q = np.array([keys_q[m.queryIdx].pt for m in good]).reshape(-1, 2)
    col, row = np.rint(pixels_r.T).astype(int)
    depth = view.depth[row.clip(0, view.depth.shape[0] - 1), col.clip(0, view.depth.shape[1] - 1)]
    keep = depth > 0
    if keep.sum() < 6:
        return prior.world_from_camera
    # OpenCV has pixel centres at whole numbers.
    rays = view.camera.rays(pixels_r[keep] + 0.5)
    points = (rays * depth[keep, None]).astype(np.float64)
    K = view.camera.K
    K[:2, 2] -= 0.5
    ok, rvec, tvec, inliers = cv2.solvePnPRansac(
        points, pixels_q[keep], K, None, iterationsCount=2000, reprojectionError=3.0
    )
    if not ok or inliers is None or len(inliers) < 6:
        return prior.world_from_camera
    chosen = inliers[:, 0]
    rvec, tvec = cv2.solvePnPRefineLM(points[chosen], pixels_q[keep][chosen], K, None, rvec, tvec)
    query_from_reference = Pose(cv2.Rodrigues(rvec)[0], tvec[:, 0])
    return view.world_from_camera @ query_from_reference.inverse


def evaluate(methods: dict[str, Method], pairs: list[TestPair], seed: int) -> list[Outcome]:
    """Every method on every pair."""
    axes = np.diag([METRES**2 / 3] * 3 + [np.radians(DEGREES) ** 2 / 3] * 3)
    outcomes = []
    for k, pair in enumerate(pairs):
        prior = PosePrior(pair.view.world_from_camera, axes, 0)
        for name, method in methods.items():
            began = time.perf_counter()
            pose = method(pair.view, pair.query, prior, seed + k)
            seconds = time.perf_counter() - began
            metres, degrees = pose.distance_to(pair.truth)
            outcomes.append(Outcome(name, pair.condition, pair.outdated, metres, degrees, seconds))
    return outcomes


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share, in percent."""
    if count == 0:
        return 0.0, 100.0
    z, p = 1.96, hits / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * np.sqrt(p * (1 - p) / count + z * z / (4 * count**2))
    return 100 * (middle - half), 100 * (middle + half)


def summary(outcomes: list[Outcome]) -> dict[str, float | int]:
    """Shares within 1 m / 1 deg and 3 m / 3 deg with intervals, and medians."""
    near = sum(o.metres < 1 and o.degrees < 1 for o in outcomes)
    close = sum(o.metres < 3 and o.degrees < 3 for o in outcomes)
    low, high = wilson(near, len(outcomes))
    low3, high3 = wilson(close, len(outcomes))
    return {
        "pairs": len(outcomes),
        "recall_1": 100 * near / len(outcomes),
        "recall_1_low": low,
        "recall_1_high": high,
        "recall_3": 100 * close / len(outcomes),
        "recall_3_low": low3,
        "recall_3_high": high3,
        "median_m": float(np.median([o.metres for o in outcomes])),
        "median_deg": float(np.median([o.degrees for o in outcomes])),
        "median_ms": 1e3 * float(np.median([o.seconds for o in outcomes])),
    }


def table(outcomes: list[Outcome]) -> dict[str, dict[str, dict[str, float | int]]]:
    """Summaries by method and group: all, each condition, outdated map."""
    result: dict[str, dict[str, dict[str, float | int]]] = {}
    for method in dict.fromkeys(o.method for o in outcomes):
        mine = [o for o in outcomes if o.method == method]
        kinds = dict.fromkeys([*CONDITIONS, *(o.condition for o in mine)])
        groups = {"all": mine} | {c: [o for o in mine if o.condition == c] for c in kinds}
        groups["outdated map"] = [o for o in mine if o.outdated]
        result[method] = {g: summary(members) for g, members in groups.items() if members}
    return result


def speed(extractor_of: Callable[[int], FeatureExtractor]) -> dict[str, float]:
    """Median milliseconds at 320 x 240 on one and two threads."""
    image = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    result = {}
    for threads in (1, 2):
        extractor = extractor_of(threads)
        times = []
        for _ in range(40):
            began = time.perf_counter()
            extractor.extract(image)
            times.append(time.perf_counter() - began)
        result[f"{threads} thread"] = 1e3 * float(np.median(times[5:]))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0, help="0, 1, 2: other places and draws")
    parser.add_argument("--model", type=Path, action="append", default=[])
    parser.add_argument("--only-models", action="store_true", help="leave the baselines out")
    parser.add_argument("--real", type=Path, help="folder of a real set, instead of made places")
    parser.add_argument("--mesh", action="store_true", help="a mesh world instead of height fields")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.mesh:
        pairs = mesh_pairs(args.pairs, args.seed)
    elif args.real is None:
        pairs = made_pairs(args.pairs, 5_000_000 + 10_000 * args.seed, threads=2)
    else:
        pairs = real_pairs(args.real, args.pairs, args.seed)
    methods: dict[str, Method] = {}
    if not args.only_models:
        methods = {
            "intensity": Direct(IntensityExtractor()),
            "gradient": Direct(GradientExtractor()),
            "SIFT + PnP": sift_pnp,
        }
    for model in args.model or [None]:
        extractor = load_extractor(model)
        methods[f"{extractor.name} {model.stem if model else ''}".strip()] = Direct(extractor)
    result = table(evaluate(methods, pairs, args.seed))
    for method, groups in result.items():
        print(f"\n{method}")
        for group, s in groups.items():
            print(
                f"  {group:13s} n={s['pairs']:<4d} 1 m/1 deg {s['recall_1']:3.0f} % "
                f"[{s['recall_1_low']:2.0f}, {s['recall_1_high']:3.0f}]  "
                f"3 m/3 deg {s['recall_3']:3.0f} % "
                f"[{s['recall_3_low']:2.0f}, {s['recall_3_high']:3.0f}]  "
                f"median {s['median_m']:.2f} m {s['median_deg']:.2f} deg  {s['median_ms']:.0f} ms"
            )
    for model in args.model or [None]:
        times = speed(lambda threads, m=model: load_extractor(m, threads=threads))
        print("\nextraction at 320x240:", {k: f"{v:.1f} ms" for k, v in times.items()})
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
