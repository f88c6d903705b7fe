"""Correlation of the errors of neighbouring images, and its effect on the sigmas.

Images of the same ground have the same map errors, so a second image adds little information. The
images' part of the covariance is therefore computed from each image's gradient together with those
of neighbouring images (Conley 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array

_REACH_M = 100.0  # on the ground: about a picture's width at the heights that are flown
_MOST_ALIKE = 0.5  # of all pairs: beyond it the flight was over one place, and tells nothing of it


@dataclass(frozen=True)
class ImageNormalEquations:
    """Normal equations of K images; each depends on S shared values of the optics and on its own
    pose. own: (K, 6, 6), both: (K, 6, S), shared: (K, S, S): blocks of the matrix; pull: (K, 6),
    shared_pull: (K, S): right sides.
    """

    own: Array
    both: Array
    shared: Array
    pull: Array
    shared_pull: Array

    @classmethod
    def of(
        cls,
        owner: NDArray[np.int64],
        weight: Array,
        value: Array,
        by_frame: Array,
        by_optics: Array,
    ) -> ImageNormalEquations:
        """From N patches: values (N, 2), derivatives (N, 2, 6) and (N, 2, S). owner: (N,) image of
        each patch, ascending, each with one at least.
        """
        begins = np.flatnonzero(np.diff(owner, prepend=-1))
        weighted, weighted_optics = (weight[:, None, None] * d for d in (by_frame, by_optics))
        each = (
            np.einsum("nai,naj->nij", weighted, by_frame),
            np.einsum("nai,naj->nij", weighted, by_optics),
            np.einsum("nai,naj->nij", weighted_optics, by_optics),
            np.einsum("nai,na->ni", weighted, value),
            np.einsum("nai,na->ni", weighted_optics, value),
        )
        return cls(*(np.add.reduceat(one, begins, axis=0) for one in each))


def images_covariance(
    gain: Array, count: int, pictures: ImageNormalEquations, grounds: Array
) -> tuple[Array, Array]:
    """The images' part (C, C) of the shared values' covariance for independent image errors, and
    the factor (C,) by which correlation increases each sigma, at least 1.

    gain: (C, C + 6 K), the first rows of the inverse of the normal equations; count: C; grounds:
    (K, 2), east and north of the ground that each image shows, m.
    """
    K, S = pictures.shared_pull.shape
    alone, pulls = np.zeros((count, count)), np.zeros((K, count))
    for k in range(K):
        mine = np.concatenate([gain[:, :S], gain[:, count + 6 * k : count + 6 * k + 6]], axis=1)
        both = pictures.both[k]
        normal = np.block([[pictures.shared[k], both.T], [both, pictures.own[k]]])
        alone += mine @ normal @ mine.T
        pulls[k] = mine @ np.concatenate([pictures.shared_pull[k], pictures.pull[k]])
    apart = np.abs(grounds[:, None] - grounds)
    weight = np.maximum(1.0 - apart / _REACH_M, 0.0).prod(axis=2)
    together = np.einsum("kc,kl,lc->c", pulls, weight, pulls, optimize=True)
    # All pulls together are nothing, which takes a part of each from those around it.
    together /= 1.0 - min(float(weight.mean()), _MOST_ALIKE)
    share = together / np.maximum(np.diag(alone), 1e-30)
    return alone, np.sqrt(np.maximum(share, 1.0))
