"""Registrations from all beginnings of a set, one line of JSON each, so that a run can go on."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from benchmarks.basin.views import BasinView
from benchmarks.integrity.beginnings import RegistrationStart, beginnings
from benchmarks.integrity.maps import place_of, shift_of
from localizer.config import LocalizerConfig
from localizer.errors import SequenceError
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_log
from localizer.integrity.probability import evidence, place_model
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.registration.agreement import PatchAgreement, PatchDisplacements
from localizer.registration.jngo import JNGO
from localizer.registration.result import Registration
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.motion import horizontal_sigma_m
from localizer.tracking.pipeline import reference_anchors
from localizer.types import Anchors, FeaturePyramid, RegistrationStatus

_LEAST_MAP = 0.1  # of a reference view, as in flight: with less there is no registration
_BYTES = 96 * 2**20  # of a map's resident tiles
_PLACES = 48  # at which views of other places are tried
_FAR_M = 1e6  # error where the place is not on the map
_NO_RIVAL = 1e3  # lead where there is no other mode: JSON has no infinity


@dataclass(frozen=True)
class StartOutcome:
    """One registration. metres, degrees: its error, and off_map_m: against the picture of a map
    whose picture is shifted; ground_m: by which its patches lie beside the true ground, root mean
    square; sigma_m: the largest of its position; gate: squared Mahalanobis
    distance from the prior, prior_sigma_m: of its horizontal place; the rest as `Registration` has
    it.
    """

    set: str
    view: int
    condition: str
    kind: str
    start_m: float
    start_deg: float
    ok: bool
    metres: float = _FAR_M
    degrees: float = 180.0
    off_map_m: float = _FAR_M
    ground_m: float = _FAR_M
    overlap: float = 0.0
    quality: float = 0.0
    sigma_m: float = 1e3
    gate: float = 1e9
    parts: int = 0
    votes: int = 0
    peak: float = 0.0
    patch_peak: float = 0.0
    lead: float = 0.0
    focal_gain: float = -1.0
    prior_sigma_m: float = 0.0

    @property
    def log_odds(self) -> float:
        """Of the right place, by all the evidence."""
        if not self.ok or self.parts == 0:
            return -np.inf
        return place_model().log_odds(self.evidence)

    @property
    def evidence(self) -> Array:
        """(5,), as `localizer.integrity.probability` has it."""
        votes = PatchAgreement(self.parts, self.votes, self.peak, self.patch_peak)
        return evidence(self.quality, votes, self.lead if self.lead < _NO_RIVAL else np.inf)

    @property
    def right(self) -> bool:
        """Within 3 m and 3 degrees, of the place that the map's picture shows."""
        return min(self.metres, self.off_map_m) <= 3 and self.degrees <= 3

    @property
    def far(self) -> bool:
        """More than 10 m wrong."""
        return min(self.metres, self.off_map_m) > 10


class MapRegistrar:
    """Registers views to whichever map a beginning names; close it when done."""

    def __init__(self, config: LocalizerConfig) -> None:
        self._config = config
        self._extractor = DetailExtractor(load_extractor(config.model, threads=1))
        self._optimizer = JNGO(config.registration, threads=1)
        self._renderers: dict[Path, NumbaRenderer] = {}
        self._elsewhere: dict[int, Anchors | None] = {}
        self._stack = ExitStack()

    def __enter__(self) -> MapRegistrar:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def outcomes(
        self, name: str, view: BasinView, index: int, here: Sequence[BasinView],
        others: Sequence[BasinView], shift: tuple[float, float],
    ) -> Iterator[StartOutcome]:  # fmt: skip
        """Of every beginning of a view that meets the map; shift: of the map's picture, m."""
        query = self._extractor.extract(view.query)
        for begun in beginnings(view, index, here, others):
            found = self._register(query, begun, index)
            if found is not None:
                yield _outcome(name, view, index, begun, found, shift)

    def _register(
        self, query: FeaturePyramid, begun: RegistrationStart, index: int
    ) -> Registration | None:
        if begun.other is not None:  # the same few places for every view: rendered once
            key = id(begun.other)
            if key not in self._elsewhere:
                self._elsewhere[key] = self._anchors(begun, begun.other.camera, index)
            anchors = self._elsewhere[key]
        else:
            anchors = self._anchors(begun, begun.camera, index)
        if anchors is None:
            return None
        found = self._optimizer.register(query, begun.camera, anchors, begun.prior, seed=index)
        return self._optimizer.with_focal_gain(query, begun.camera, anchors, found)

    def _anchors(self, begun: RegistrationStart, camera: Camera, seed: int) -> Anchors | None:
        pose = begun.prior.world_from_camera
        reference = self._renderer(begun.map_cache).render(pose, camera, wait=True)
        if (reference.depth > 0).mean() < _LEAST_MAP:
            return None
        return reference_anchors(reference, self._extractor, self._config.anchors, seed)

    def _renderer(self, cache: Path) -> NumbaRenderer:
        if cache not in self._renderers:
            streamer = self._stack.enter_context(
                TileStreamer(TileCache.open(cache), byte_budget=_BYTES)
            )
            self._renderers[cache] = NumbaRenderer(streamer, 1)
        return self._renderers[cache]


def _outcome(
    name: str, view: BasinView, index: int, begun: RegistrationStart, found: Registration,
    shift: tuple[float, float],
) -> StartOutcome:  # fmt: skip
    head = StartOutcome(
        name, index, view.condition, begun.kind, begun.start_m, begun.start_deg,
        found.status is RegistrationStatus.OK,
    )  # fmt: skip
    if not head.ok:
        return head
    metres, degrees, off_map, ground = _FAR_M, 180.0, _FAR_M, _FAR_M
    pose, truth = found.world_from_camera, view.truth
    if begun.has_truth:
        metres, degrees = pose.distance_to(truth)
        off_map = float(np.linalg.norm(pose.translation - truth.translation - [*shift, 0.0]))
    votes = found.agreement
    if votes is None:
        raise SequenceError("the registration did not say how the image's patches agree")
    if begun.has_truth and votes.displacements is not None:
        ground = ground_error_m(votes.displacements, pose, truth)
    return replace(
        head,
        metres=metres,
        degrees=degrees,
        off_map_m=off_map,
        ground_m=ground,
        overlap=found.overlap,
        quality=found.quality,
        sigma_m=float(np.sqrt(found.covariance.diagonal()[:3].max())),
        gate=begun.prior.mahalanobis_squared(pose, found.covariance),
        parts=votes.patches,
        votes=votes.votes,
        peak=votes.peak,
        patch_peak=votes.patch_peak,
        lead=min(found.lead, _NO_RIVAL),
        focal_gain=max(found.focal_gain, -1.0),
        prior_sigma_m=horizontal_sigma_m(begun.prior),
    )


def ground_error_m(patches: PatchDisplacements, pose: Pose, truth: Pose) -> float:
    """How far a pose shows the ground of its patches beside where it is, root mean square, m. A
    tilt and a shift that cancel on the ground count little. To first order.
    """
    if len(patches.shift) == 0:
        return _FAR_M
    turn = so3_log(pose.rotation @ truth.rotation.T)
    pixels = patches.motion @ np.concatenate([pose.translation - truth.translation, turn])
    per_metre = np.linalg.norm(patches.motion[:, :, :2], axis=(1, 2)).mean() / np.sqrt(2.0)
    return float(np.sqrt((pixels**2).sum(axis=1).mean()) / per_metre)


def run_set(
    name: str,
    views: Sequence[BasinView],
    everywhere: Sequence[BasinView],
    path: Path,
    more_time: Callable[[], bool],
    seen: Path | None = None,
) -> int:
    """Append the views that `path` lacks, as long as there is time; how many are left.

    everywhere: views, of which some of other places serve as wrong beginnings; seen: another run's
    outcomes of the set, whose views are left out (photos that are given again, too).
    """
    places, shift = places_of(everywhere), shift_of(name)
    kept = read(path) if path.exists() else []
    if path.exists() and len(kept) != len(path.read_text().splitlines()):
        path.write_text("".join(json.dumps(asdict(o)) + "\n" for o in kept))
    done = {o.view for o in kept}
    left = [k for k in unseen(views, seen) if k not in done]
    with MapRegistrar(LocalizerConfig()) as registrar, path.open("a") as file:
        while left and more_time():
            k = left.pop(0)
            here, others = _around(views, k, places)
            rows = list(registrar.outcomes(name, views[k], k, here, others, shift))
            # A view whole or not at all: an interrupted run tries it again.
            file.write("".join(json.dumps(asdict(o)) + "\n" for o in rows))
            file.flush()
    return len(left)


def unseen(views: Sequence[BasinView], seen: Path | None) -> list[int]:
    """The numbers of the views that another run's outcomes do not have, each picture once."""
    if seen is None:
        return list(range(len(views)))
    known = {id(views[o.view]) for o in read(seen)} if seen.exists() else set()
    first = {id(view): k for k, view in reversed(list(enumerate(views)))}
    return [k for k, view in enumerate(views) if id(view) not in known and first[id(view)] == k]


def places_of(everywhere: Sequence[BasinView]) -> list[BasinView]:
    """The views at whose places others are tried."""
    chosen = np.random.default_rng(37).permutation(len(everywhere))[:_PLACES]
    return [everywhere[int(k)] for k in chosen]


def _around(
    views: Sequence[BasinView], k: int, places: Sequence[BasinView]
) -> tuple[list[BasinView], list[BasinView]]:
    """The views of a view's own map, and those of other places."""
    own, at = views[k].map_cache, place_of(views[k])
    return [v for v in views if v.map_cache == own], [v for v in places if place_of(v) != at]


def read(path: Path) -> list[StartOutcome]:
    """The outcomes of a file; a line that an interrupt cut short is left out with its view."""
    rows, cut = [], set()
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            cut.add(rows[-1]["view"] if rows else 0)
    names = {f.name for f in fields(StartOutcome)}
    if any(set(row) != names for row in rows):
        raise SequenceError(f"{path}: not a file of this benchmark: begin anew without it")
    return [StartOutcome(**row) for row in rows if row["view"] not in cut]


def turn(more_time: Callable[[], bool], count: int) -> Callable[[], bool]:
    """As `more_time`, but for so many calls at the most."""
    calls = iter(range(count))
    return lambda: next(calls, None) is not None and more_time()
