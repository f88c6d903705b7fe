"""What the convergence benchmark compares: the paper's steps, ours, ours with one thing changed.

A variant is a configuration and, where a choice is not one of the configuration's, replacements of
the functions that make it. Nothing here is used by the product.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from localizer.geometry.pose import Array
from localizer.registration import hypotheses as hypothesis_module
from localizer.registration.anchors import select_anchors
from localizer.registration.backend import Backend, LevelProblem, LMSettings, Refinement
from localizer.registration.config import JNGOConfig
from localizer.registration.jngo import JNGO
from localizer.types import Anchors, FeaturePyramid, PosePrior, RenderedView

_ANCHORS = 4000
FULL = "ours"


@dataclass(frozen=True)
class Variant:
    """One row. anchors: N; motion: whether the prior serves as the prediction of Eq. 10;
    confidence: False takes all confidences as 1; detail: False leaves the detail level out;
    patches: (dotted name, replacement); loss: changes the backend's settings.
    """

    name: str
    config: JNGOConfig = field(default_factory=JNGOConfig)
    anchors: int = _ANCHORS
    motion: bool = True
    confidence: bool = True
    detail: bool = True
    patches: tuple[tuple[str, object], ...] = ()
    loss: Callable[[LMSettings], LMSettings] | None = None

    def optimizer(self) -> JNGO:
        """An optimizer of this variant, one thread."""
        made = JNGO(self.config, threads=1)
        if self.loss is not None:
            made.backend = _OtherLoss(made.backend, self.loss)
        return made

    @property
    def selection(self) -> tuple[object, ...]:
        """What its anchors depend on; variants with equal ones can share them."""
        own = tuple(p for p in self.patches if p[0].startswith("anchors."))
        return self.anchors, self.confidence, self.detail, own

    def select(self, view: RenderedView, features: FeaturePyramid, seed: int) -> Anchors:
        """This variant's anchors of a reference view."""
        anchors = select_anchors(view, self.shown(features), self.anchors, seed)
        if self.confidence:
            return anchors
        return replace(anchors, confidence=tuple(np.ones_like(c) for c in anchors.confidence))

    def shown(self, features: FeaturePyramid) -> FeaturePyramid:
        """The levels that this variant may see."""
        return features if self.detail else replace(features, levels=features.levels[:-1])

    @contextmanager
    def active(self) -> Iterator[None]:
        """The patches, while anchors are selected and registered."""
        with ExitStack() as stack:
            for name, replacement in self.patches:
                stack.enter_context(mock.patch(f"localizer.registration.{name}", replacement))
            yield


class _OtherLoss:
    """A backend that replaces the settings it is given."""

    def __init__(self, backend: Backend, change: Callable[[LMSettings], LMSettings]) -> None:
        self.name, self._backend, self._change = backend.name, backend, change

    def refine(
        self, problem: LevelProblem, rotations: Array, translations: Array, iterations: int,
        settings: LMSettings,
    ) -> Refinement:  # fmt: skip
        """As `Backend.refine`."""
        return self._backend.refine(
            problem, rotations, translations, iterations, self._change(settings)
        )


def paper_rows() -> list[Variant]:
    """Table 4's system rows: the paper's optimizer with our features, our anchors and our units of
    Eq. 10. Its prediction here is the wrong start, which no flight has: `benchmarks.places` gives
    it the filter's.
    """
    paper = JNGOConfig(
        hypotheses=1, survivors=(144, 144), iterations=(2, 3, 4), sharpen=0,
        swarm_anchors=(500, 500, 500), duplicate_px=0.0, preselected=0,
    )  # fmt: skip
    swarm = replace(paper, hypotheses=144)

    def row(name: str, config: JNGOConfig, *, motion: bool) -> Variant:
        return Variant(name, config, 500, motion, detail=False, patches=_VERTICAL_TURNS)

    return [
        row("paper's optimizer, our features: one hypothesis", paper, motion=False),
        row("... + rotation-aware swarm", swarm, motion=False),
        row("... + motion term to the start", swarm, motion=True),
    ]


def changed(name: str, **values: Any) -> Variant:
    """The default configuration with other values."""
    return Variant(name, replace(JNGOConfig(), **values))


def our_rows() -> list[Variant]:
    """The default, and the default with one thing changed at a time."""
    return [
        Variant(FULL),
        changed("one hypothesis", hypotheses=1),
        changed("swarm alone, no draws of the prior", preselected=0),
        Variant("without motion term", motion=False),
        changed("no halving: all 144 to the end", survivors=(144, 144)),
        changed("halving to 32 and 8", survivors=(32, 8)),
        changed("survivors may repeat", duplicate_px=0.0),
        changed("10 iterations at the end, not 4", iterations=(2, 3, 10)),
        Variant("without detail level", detail=False),
        Variant("without detail level, N = 2000", anchors=2000, detail=False),
        changed("detail without sharpening before", sharpen_scales=()),
        changed("winner not sharpened", sharpen=0),
        Variant("sharpened under Huber", loss=_huber),
        Variant("redescending loss in the search", loss=_redescending),
        Variant("turns about the vertical", patches=_VERTICAL_TURNS),
        Variant("anchors on depth edges too", patches=_DEPTH_EDGES),
        changed("500 coarse anchors, not 250", swarm_anchors=(500, 500, 500)),
        Variant("N = 500", anchors=500),
        Variant("N = 2000", anchors=2000),
        Variant("N = 8000", anchors=8000),
        Variant("without confidence", confidence=False),
    ]


def _huber(settings: LMSettings) -> LMSettings:
    return replace(settings, redescending=False, scale=0.5)


def _redescending(settings: LMSettings) -> LMSettings:
    return settings if settings.redescending else replace(settings, redescending=True)


def _vertical_turns(prior: PosePrior, *arguments: Any, **values: Any) -> tuple[Array, Array]:
    """The same swarm with yaw about the world's vertical and pitch about the horizontal x axis."""
    R = prior.world_from_camera.rotation
    rotations, centres = hypothesis_module.generate_hypotheses(prior, *arguments, **values)
    offsets = Rotation.from_matrix(R.T @ rotations).as_rotvec()
    across = np.array([R[0, 0], R[1, 0], 0.0])
    across /= max(float(np.linalg.norm(across)), 1e-9)
    pitch = Rotation.from_rotvec(offsets[:, :1] * across)
    yaw = Rotation.from_rotvec(offsets[:, 1:2] * np.array([0.0, 0.0, 1.0]))
    roll = Rotation.from_rotvec(offsets[:, 2:] * R[:, 2])
    return np.asarray((yaw * pitch * roll).as_matrix() @ R), centres


_VERTICAL_TURNS = (("config.generate_hypotheses", _vertical_turns),)
_DEPTH_EDGES = (("anchors._MAX_CURVATURE", np.inf),)
