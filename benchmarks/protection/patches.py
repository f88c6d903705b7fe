"""How far on the ground a map errs alike: recorded flights by the bound that it would have told.

    python -m benchmarks.protection.patches report-demo/ [...] --recorded 5 --json patches.json

The bound of a position holds `localizer.calibration.map_m`, displaced patch by patch of
`map_length_m`. Of each recorded position the share of the map is taken out and put in again for
other lengths, over ground that is flat and as high as the take-off. A length is judged by the mean
logarithm of the likelihood of the horizontal errors, which a bound that is too wide loses, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from companion.config import load_config
from companion.errors import RecordError
from companion.offline.tables import poses, read_columns
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.registration.calibration import CalibrationSigmas, calibration_covariance

LENGTHS_M = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0)
COLUMNS = ("flight", "positions", "patches, m", "inside 95 %", "log likelihood", "sigma, m")
_CHI2_95 = 5.991  # of two degrees of freedom
_MATCH_NS = 2_000_000
_LOW_M = 5.0  # below it a flat ground is none
_EVERY_PX = 16
_LEAST_M = 0.02  # of a sigma
_GRAZING = 0.1  # of a ray's unit length downwards, below which it meets the ground too far away


@dataclass(frozen=True)
class FlightPositions:
    """The positions of a flight. errors: (N, 2) east and north; covariances: (N, 2, 2) without the
    map's share; shares: (N, 2, 2) of a map in patches of one metre.
    """

    name: str
    errors: Array
    covariances: Array
    shares: Array

    def judged(self, length_m: float) -> tuple[float, float, float]:
        """Share inside, mean log likelihood and mean sigma (an axis), with patches of a length."""
        P = self.covariances + length_m**2 * self.shares
        nees = np.einsum("ni,nij,nj->n", self.errors, np.linalg.inv(P), self.errors)
        likelihood = -0.5 * (nees + np.log(np.linalg.det(P)))
        sigma = np.sqrt(0.5 * np.trace(P, axis1=1, axis2=2).mean())
        return float(np.mean(nees <= _CHI2_95)), float(likelihood.mean()), float(sigma)


def read_told(folder: Path, recorded_m: float) -> FlightPositions:
    """A flight's folder. recorded_m: the length with which its bounds were told."""
    config = load_config(folder / "companion.yaml")
    try:
        truth, told = read_columns(folder / "frames.csv"), _told(folder / "companion")
        stamps, true_poses = truth["exposure_time_ns"], poses(truth)
    except KeyError as error:
        raise RecordError(f"{folder}: a table of the record has no {error}, or no rows") from error
    sigmas = config.localizer.calibration
    unit = CalibrationSigmas.none().model_copy(update={"map_m": sigmas.map_m, "map_length_m": 1.0})
    seen, width = config.camera.model.camera().without_distortion(), config.localizer.width
    camera = seen.resized(width, round(seen.height * width / seen.width))
    ground_m = float(min(truth["up_m"][:30]))
    errors, covariances, shares = [], [], []
    for time_ns, pose, covariance in told:
        i = int(np.argmin(np.abs(stamps - time_ns)))
        low = pose.translation[2] - ground_m < _LOW_M
        if low or abs(int(stamps[i]) - time_ns) > _MATCH_NS:
            continue
        share = _share(unit, pose, camera, ground_m)
        errors.append((pose.translation - true_poses[i].translation)[:2])
        covariances.append(_at_least(covariance - recorded_m**2 * share))
        shares.append(share)
    if not errors:
        raise RecordError(f"{folder}: no accepted position above {_LOW_M:g} m")
    return FlightPositions(folder.name, np.array(errors), np.array(covariances), np.array(shares))


def _told(record: Path) -> list[tuple[int, Pose, Array]]:
    """(time, pose, horizontal covariance (2, 2)) of the accepted positions of a record."""
    estimates = read_columns(record / "estimates.csv", ("state", "status"))
    bounds = read_columns(record / "covariances.csv", ("name",))
    at = {int(t): k for k, t in enumerate(bounds["exposure_time_ns"])}
    found = []
    for k, pose in enumerate(poses(estimates)):
        time_ns = int(estimates["exposure_time_ns"][k])
        if estimates["accepted"][k] > 0 and time_ns in at:
            a, b, c = (bounds[name][at[time_ns]] for name in ("c00", "c01", "c11"))
            found.append((time_ns, pose, np.array([[a, b], [b, c]])))
    return found


def _at_least(covariance: Array) -> Array:
    """What is left must be one: over ground that is not flat the map's share was smaller."""
    values, axes = np.linalg.eigh(covariance)
    left: Array = (axes * np.maximum(values, _LEAST_M**2)) @ axes.T
    return left


def _share(unit: CalibrationSigmas, pose: Pose, camera: Camera, ground_m: float) -> Array:
    """(2, 2): what a map displaced in patches of one metre adds, seen from a pose."""
    u, v = np.meshgrid(
        np.arange(0.5 * _EVERY_PX, camera.width, _EVERY_PX),
        np.arange(0.5 * _EVERY_PX, camera.height, _EVERY_PX),
    )
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()])) @ pose.rotation.T
    rays = rays[rays[:, 2] < -_GRAZING]
    points = pose.translation + rays * ((ground_m - pose.translation[2]) / rays[:, 2])[:, None]
    still = (np.zeros(3), np.zeros(3))
    return calibration_covariance(unit, points, pose, camera, None, still)[:2, :2]


def table(flights: Sequence[FlightPositions], lengths_m: Sequence[float]) -> list[list[str]]:
    """A row for each flight and length, and for all flights together: each counts alike."""
    rows = []
    for name, some in [*((f.name, [f]) for f in flights), ("all", list(flights))]:
        count = str(sum(len(f.errors) for f in some))
        for length_m in lengths_m:
            inside, likelihood, sigma = np.mean([f.judged(length_m) for f in some], axis=0)
            cells = (f"{length_m:g}", f"{100 * inside:.1f} %", f"{likelihood:.2f}", f"{sigma:.2f}")
            rows.append([name, count, *cells])
    return rows


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("flights", type=existing, nargs="+", help="folders of `sitl demo`")
    parser.add_argument("--recorded", type=number(0.01, 1000.0), required=True,
                        help="map_length_m of the deployment that flew")  # fmt: skip
    parser.add_argument("--lengths", type=number(0.01, 1000.0), nargs="+", default=LENGTHS_M,
                        help="of patches, m")  # fmt: skip
    parser.add_argument("--json", type=output, help="the table")
    args = parser.parse_args()
    rows = table([read_told(f, args.recorded) for f in args.flights], args.lengths)
    show_figures(args.json, COLUMNS, rows)


if __name__ == "__main__":
    with named_errors():
        main()
