"""A flown pursuit followed again from the pictures and poses of its record: what fails, and why.

    python -m benchmarks.targets.refollow FOLDER [--json out.json]

FOLDER is a flight's of `python -m sitl follow` (OUT/VEHICLE-SEED-DRAW). Its click, its frames as
they came over the video link and its poses go through the companion's own targets once more; the
result is judged against the car as in flight. Pictures that were not taken up then are left out.
"""

from __future__ import annotations

import csv
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.common.arguments import Parser, output
from benchmarks.common.named_errors import named_errors
from companion.offline.replay import FlightRecord, image_path, load_record
from companion.targets.detections import clicked_name
from companion.targets.history import PoseHistory
from companion.targets.target_manager import Click, TargetEstimate, TargetManager
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.surface import MapSurface
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState, Visibility
from sitl.demo.assets import prepare
from sitl.operator.chase import make_chase
from sitl.operator.follow_run import FLIGHT
from sitl.operator.followed import FollowedFix, follow_verdict
from sitl.operator.pursuer import FOLLOWED_S, LEAD_S

_UPPER = np.triu_indices(6)


def refollow(folder: Path) -> dict[str, Any]:
    """One flight once more; what came of it."""
    row = _row(folder)
    begin_ns = int(row["begin_ns"])
    record = load_record(folder / "companion")
    assets = prepare(int(row["seed"]), size_m=FLIGHT.size_m)
    cache = TileCache.open(assets.map_cache)
    chase = make_chase(
        assets.world, cache.frame, begin_ns - round(LEAD_S * 1e9), LEAD_S, int(row["draw"])
    )
    told: list[TargetEstimate] = []
    texts: list[str] = []
    population = TargetManager(
        record.config.targets, MapSurface(cache).cast, told.append, lambda _: None,
        lambda _, text: texts.append(text),
    )  # fmt: skip
    _fly(record, population, _click(folder / "companion" / "targets.csv"))
    fixes = [_fix(t) for t in told if t.fix.target_id == clicked_name(1)]
    verdict = follow_verdict(fixes, chase, begin_ns + round(FOLLOWED_S * 1e9), texts)
    flown = row["verdict"]["is_followed"] if row["verdict"] else None
    return {"seed": row["seed"], "draw": row["draw"], "flown": flown, **asdict(verdict)}


def _row(folder: Path) -> dict[str, Any]:
    rows = json.loads((folder.parent / "follow.json").read_text(encoding="utf-8"))
    for row in rows:
        if f"{row['vehicle']}-{row['seed']}-{row['draw']}" == folder.name:
            return dict(row)
    raise ValueError(f"{folder.parent / 'follow.json'}: has no flight {folder.name}")


def _click(targets: Path) -> tuple[int, tuple[float, float]]:
    """(time of its frame, pixel) of the first click."""
    with targets.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["target_id"] == clicked_name(1):
                return int(row["exposure_time_ns"]), (float(row["u"]), float(row["v"]))
    raise ValueError(f"{targets}: no target was clicked at")


def _fly(
    record: FlightRecord, population: TargetManager, click: tuple[int, tuple[float, float]]
) -> None:
    """Pictures and click in the order in which they came."""
    frame_ns, pixel = click
    config = record.config.targets
    came_ns = frame_ns + round(config.operator_delay_ms * 1e6)
    sigma_ns = round(config.operator_delay_sigma_ms * 1e6)
    history, covariances, is_begun = PoseHistory(), _covariances(record.folder), False
    camera = record.config.camera.model.camera()
    for one in record.estimates:
        picture = image_path(record.folder, one)
        if not one.accepted or not picture.is_file():
            continue
        state = TrackingState.TRACKING if one.is_tracking else TrackingState.INITIALIZING
        estimate = PoseEstimate(
            one.world_from_camera, covariances.get(one.exposure_time_ns, np.zeros((6, 6))), 1.0,
            state, RegistrationStatus.OK, True, one.exposure_time_ns, one.sequence, camera,
        )  # fmt: skip
        if not is_begun and one.known_ns > came_ns and (seen := history.at(frame_ns)) is not None:
            around = (history.at(frame_ns + s * sigma_ns) for s in (-1, 1))
            population.begin(Click(1, seen, pixel, tuple(a for a in around if a is not None)))
            is_begun = True
        history.add(estimate)
        gray = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
        population.look(estimate, np.asarray(gray, dtype=np.uint8))
        population.hold(estimate)


def _covariances(folder: Path) -> dict[int, Array]:
    """(6, 6) by the frame's time, of ``covariances.csv``."""
    found = {}
    with (folder / "covariances.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            half = np.zeros((6, 6))
            half[_UPPER] = [float(row[f"c{i}{j}"]) for i, j in zip(*_UPPER, strict=True)]
            found[int(row["exposure_time_ns"])] = half + np.triu(half, 1).T
    return found


def _fix(target: TargetEstimate) -> FollowedFix:
    fix = target.fix
    return FollowedFix(
        fix.exposure_time_ns, fix.position_world, fix.covariance, fix.velocity,
        fix.velocity_covariance, fix.visibility is Visibility.SEEN,
    )  # fmt: skip


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("folder", type=Path, help="of a flight of `python -m sitl follow`")
    parser.add_argument("--json", type=output, help="the verdict and every error")
    args = parser.parse_args()
    document = refollow(args.folder)
    if args.json:
        Path(args.json).write_text(json.dumps(document, indent=1))
    print(json.dumps({k: v for k, v in document.items() if not isinstance(v, list | tuple)}))


if __name__ == "__main__":
    with named_errors():
        main()
