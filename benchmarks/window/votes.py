"""The vote of a window's frames for the pose of its newest (fixed lag, marginalised).

A frame's registration is one vote: a pose, its covariance, and how far it may be trusted. Each step
carries all votes to the newest frame and adds the step's noise, so that nothing of an older frame
is kept but its vote. The pose is the mode of the product of the votes, each a normal density or,
with the rest of the trust, a place anywhere in the box that a prior leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.window.motions import MotionStep
from localizer.geometry.pose import Array, Pose, so3_exp, so3_log

_BOX = (16.0, np.radians(12.0))  # sides: metres, radians
_FLOOR = (0.1, np.radians(0.05))  # least sigmas of a vote
_STARTS, _ITERATIONS, _ENOUGH_M = 4, 10, 1e-3
_ANYWHERE = 3 * np.log(2 * np.pi) - 3 * np.log(_BOX[0]) - 3 * np.log(_BOX[1])  # 2 pi: as below


@dataclass(frozen=True)
class Vote:
    """What one frame says. covariance: (6, 6) as `PosePrior`'s; trust: 0 to 1."""

    pose: Pose
    covariance: Array
    trust: float

    def carried(self, step: MotionStep) -> Vote:
        """The vote for the next frame."""
        return Vote(*step.carry(self.pose, self.covariance), self.trust)


class Window:
    """The last frames' votes, carried to the newest. robust: False trusts every vote fully."""

    def __init__(self, frames: int, *, robust: bool = True) -> None:
        self._frames, self._robust = frames, robust
        self._votes: list[Vote] = []

    def add(self, vote: Vote, step: MotionStep | None) -> Pose:
        """The window's pose of this frame; step: the motion since the last, None of the first."""
        if step is not None:
            self._votes = [v.carried(step) for v in self._votes]
        self._votes = [*self._votes, vote][-self._frames :]
        return elected(self._votes, robust=self._robust)


def elected(votes: Sequence[Vote], *, robust: bool = True) -> Pose:
    """The pose that most of the votes are for."""
    ballot = _Ballot(votes, robust=robust)
    scores = [ballot.read(vote.pose)[2] for vote in votes]
    best, highest = votes[0].pose, -np.inf
    for k in np.argsort(scores)[::-1][:_STARTS]:
        pose = ballot.climbed(votes[k].pose)
        score = ballot.read(pose)[2]
        if score > highest:
            best, highest = pose, score
    return best


class _Ballot:
    """The votes as arrays over n."""

    def __init__(self, votes: Sequence[Vote], *, robust: bool) -> None:
        floor = np.diag(np.repeat(_FLOOR, 3) ** 2)
        covariances = np.stack([v.covariance for v in votes]) + floor
        self._poses = [v.pose for v in votes]
        self._information = np.linalg.inv(covariances)
        self._peak = -0.5 * np.linalg.slogdet(covariances)[1]
        self._trust = np.array([v.trust for v in votes]) if robust else np.ones(len(votes))

    def read(self, pose: Pose) -> tuple[Array, Array, float]:
        """Differences (n, 6) to a pose, how far each vote is for it (n,), and their log product."""
        d = np.array(
            [
                [*(p.translation - pose.translation), *so3_log(p.rotation @ pose.rotation.T)]
                for p in self._poses
            ]
        )
        squared = np.einsum("ni,nij,nj->n", d, self._information, d)
        with np.errstate(divide="ignore"):
            here = np.log(self._trust) + self._peak - 0.5 * squared
            anywhere = np.log(1.0 - self._trust) + _ANYWHERE
        both = np.logaddexp(here, anywhere)
        return d, np.exp(here - both), float(both.sum())

    def climbed(self, pose: Pose) -> Pose:
        """The mode that is reached from a pose by reweighted least squares."""
        for _ in range(_ITERATIONS):
            d, share, _ = self.read(pose)
            H = np.einsum("n,nij->ij", share, self._information) + 1e-9 * np.eye(6)
            step = np.linalg.solve(H, np.einsum("n,nij,nj->i", share, self._information, d))
            pose = Pose(so3_exp(step[3:]) @ pose.rotation, pose.translation + step[:3])
            if np.linalg.norm(step[:3]) < _ENOUGH_M:
                break
        return pose
