"""What a sliding window would be worth: the last frames vote for one pose, against single frames.

    python -m benchmarks.window --sets dusk combined day --places 12 --json window.json
    python -m benchmarks.window --sets neon --places 16 --beginnings alike own true
    python -m benchmarks.window --sets dusk combined neon --tilt 0.5

Each place is flown over for some seconds at two frames a second. Every frame is registered with the
shipped network from where a tracker would believe to be: 5 m and 5 degrees off, alike in all frames
of a place, with a drift. Beginnings that are each off in a direction of their own, or not at all,
tell whether the error that frames share comes from the beginning or from the pictures.

A registration's pose, covariance and quality are its vote; votes are carried to the newest frame by
the motion that odometry or an autopilot without GNSS would measure. "mean" trusts every vote, as a
Kalman filter does; "vote" leaves out what does not agree. Share of frames within 1 m and 1 degree,
in per cent, from the fifth frame on; the change against single frames with its 95 % interval over
places; last, how much of the squared error the frames of a place share, over the places where less
than half of the frames are right: no vote can take that away.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors, needs_torch
from benchmarks.window.motions import MOTIONS
from benchmarks.window.report import COLUMNS, Error, Errors, rows
from benchmarks.window.votes import Vote, Window
from localizer.config import LocalizerConfig
from localizer.features import load_extractor
from localizer.features.detail import DetailExtractor
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.registration import JNGO, attitude_constraint
from localizer.types import FeaturePyramid, PosePrior, RegistrationStatus, RenderedView

with needs_torch():
    from benchmarks.features.pairs import DEGREES, MADE_CONDITIONS, METRES
    from benchmarks.window.sequences import (
        ALIKE,
        BEGINNINGS,
        INTERVAL_S,
        NEON,
        SequenceFrame,
        made_sequence,
        plot_sequence,
    )
    from localizer.tracking.pipeline import reference_anchors

_TRUST = (0.1, 3.0, 0.9)  # of a vote: its quality times this, within these


PLAIN, LEVEL = "", ", level"


@dataclass(frozen=True)
class WindowFlight:
    """One place's frames: where they were, and what the registrations of each say: `PLAIN`, or
    with roll and pitch heard, `LEVEL`.
    """

    place: int
    truths: list[Pose]
    votes: dict[str, list[Vote]]


class FrameRegistrar:
    """Registers frames as the product does. tilt_deg: None hears no roll and pitch."""

    def __init__(self, tilt_deg: float | None = None) -> None:
        self._tilt = None if tilt_deg is None else float(np.radians(tilt_deg))
        self._extractor = DetailExtractor(load_extractor(None))
        self._optimizer, self._anchors = JNGO(), LocalizerConfig().anchors
        self._spread = np.diag([METRES**2 / 3] * 3 + [np.radians(DEGREES) ** 2 / 3] * 3)

    def flown(
        self, place: int, frames: Iterator[SequenceFrame], beginnings: Sequence[str]
    ) -> dict[str, WindowFlight]:
        """Every frame of a sequence, by beginning."""
        kinds = (PLAIN,) if self._tilt is None else (PLAIN, LEVEL)
        off = np.random.default_rng((place, 72)).normal(0.0, self._tilt or 0.0, 3) * (1, 1, 0)
        flights = {b: WindowFlight(place, [], {kind: [] for kind in kinds}) for b in beginnings}
        for k, frame in enumerate(frames):
            query = self._extractor.extract(frame.query)
            for begins, flight in flights.items():
                flight.truths.append(frame.truth)
                for kind, votes in flight.votes.items():
                    heard = so3_exp(off) @ frame.truth.rotation if kind == LEVEL else None
                    votes.append(self._vote(query, frame.views[begins], heard, k))
        return flights

    def _vote(
        self, query: FeaturePyramid, view: RenderedView, heard: Array | None, seed: int
    ) -> Vote:
        prior = PosePrior(view.world_from_camera, self._spread, 0)
        anchors = reference_anchors(view, self._extractor, self._anchors, seed)
        level = None
        if heard is not None and self._tilt is not None:
            level = attitude_constraint(heard, self._tilt, np.pi)
        found = self._optimizer.register(
            query, view.camera, anchors, prior, constraint=level, seed=seed
        )
        if found.status is not RegistrationStatus.OK:
            return Vote(found.world_from_camera, 4 * self._spread, _TRUST[0])
        trust = float(np.clip(found.quality * _TRUST[1], _TRUST[0], _TRUST[2]))
        return Vote(found.world_from_camera, found.covariance, trust)


def windowed(
    flown: WindowFlight, kind: str, motion: str, frames: int, *, robust: bool
) -> list[Pose]:
    """The window's pose of every frame."""
    steps = MOTIONS[motion](flown.truths, INTERVAL_S, np.random.default_rng(flown.place))
    window = Window(frames, robust=robust)
    pairs = zip(flown.votes[kind], [None, *steps], strict=True)
    return [window.add(vote, step) for vote, step in pairs]


def errors(flown: WindowFlight, windows: list[int], motions: Sequence[str]) -> Errors:
    """Errors of single frames and of every window, by (motion, kind, frames)."""

    def against(poses: list[Pose]) -> list[Error]:
        return [
            Error(p.translation - t.translation, p.distance_to(t)[1])
            for p, t in zip(poses, flown.truths, strict=True)
        ]

    found: Errors = {
        ("", f"single{kind}", 1): against([v.pose for v in votes])
        for kind, votes in flown.votes.items()
    }
    for motion, kind, elects, frames in product(motions, flown.votes, ("mean", "vote"), windows):
        poses = windowed(flown, kind, motion, frames, robust=elects == "vote")
        found[motion, f"{elects}{kind}", frames] = against(poses)
    return found


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("--sets", nargs="+", choices=(*MADE_CONDITIONS, NEON), default=["dusk"],
                   help="conditions of the generated places, or the plots")  # fmt: skip
    p.add_argument("--places", type=whole(1, 1000), default=12, help="of each set")
    p.add_argument("--first", type=whole(0, 1000), default=0, help="place")
    p.add_argument("--frames", type=whole(5, 200), default=12, help="of each place")
    p.add_argument("--windows", type=whole(1, 200), nargs="+", default=[5, 10], help="frames")
    p.add_argument("--motions", nargs="+", choices=tuple(MOTIONS), default=list(MOTIONS),
                   help="that tie the frames")  # fmt: skip
    p.add_argument("--beginnings", nargs="+", choices=BEGINNINGS, default=[ALIKE],
                   help="of the registrations")  # fmt: skip
    p.add_argument("--tilt", type=number(0.01, 90), help="error of roll and pitch, degrees")
    p.add_argument("--split", choices=("test", "validation"), default="test", help="of places")
    p.add_argument("--textures", type=existing, default=Path("../shared/data/textures"),
                   help="real textures")  # fmt: skip
    p.add_argument("--json", type=output, help="the table, for the documentation")
    args = p.parse_args()
    registrar = FrameRegistrar(args.tilt)
    table: list[tuple[str, ...]] = []
    for name in args.sets:
        places: dict[str, list[Errors]] = {begins: [] for begins in args.beginnings}
        for k in range(args.first, args.first + args.places):
            if name == NEON:
                frames = plot_sequence(k, args.frames, args.textures)
            else:
                frames = made_sequence(name, k, args.frames, args.split, args.textures)
            for begins, flight in registrar.flown(k, frames, args.beginnings).items():
                places[begins].append(errors(flight, args.windows, args.motions))
            if args.json:
                write_figures(args.json, COLUMNS, [*table, *_rows(name, places)])
        table += _rows(name, places)
    for row in (COLUMNS, *table):
        print(" | ".join(row))


def _rows(name: str, places: dict[str, list[Errors]]) -> list[tuple[str, ...]]:
    return [row for begins, some in places.items() for row in rows(name, begins, some)]


if __name__ == "__main__":
    with named_errors():
        main()
