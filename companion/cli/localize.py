"""``companion localize``: estimate where images were taken, without true poses."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from companion.cli.before.shared_options import (
    Device,
    FeatureNetwork,
    Renderer,
    WorkingWidth,
    numbers,
)
from companion.cli.output import tell_notes
from companion.errors import ConfigError
from companion.offline.localize import (
    LocalizedImage,
    Sigmas,
    image_times,
    localize_images,
    sensors_of,
)
from companion.sources.folder_source import list_images
from companion.terminal.steps import COMPILES, show_count, tally
from companion.trajectory import TRAJECTORY_NAMES, to_stamped_pose, write_trajectory
from companion.writing import make_folder, refuse_input, writing
from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.geometry.trajectory import PoseRow, read_poses, world_from_camera
from localizer.map.cache.cache import TileCache
from localizer.tracking.opening import open_localizer
from localizer.types import PoseEstimate

COLUMNS = (
    "name", "latitude_deg", "longitude_deg", "height_m", "sigma_east_m", "sigma_north_m",
    "sigma_up_m", "sigma_rotation_deg", "quality", "state", "status", "accepted", "problem",
)  # fmt: skip


def localize_command(
    images: Annotated[Path, typer.Argument(help="an image, or a folder of images in order")],
    map_cache: Annotated[Path, typer.Option("--map", help="tile cache")],
    camera: Annotated[Path, typer.Option(help="camera.json: the images' intrinsics")],
    prior: Annotated[
        str | None,
        typer.Option(
            help="approximate pose of the first image: LAT,LON,HEIGHT,ROLL,PITCH,YAW in degrees "
            "and metres above the ellipsoid; angles as in a pose file: pitch 0 looks straight down "
            "(in `map render` -90 does), yaw is counter-clockwise from north"
        ),
    ] = None,
    priors: Annotated[
        Path | None, typer.Option(help="pose file: approximate pose of each named image")
    ] = None,
    prior_sigma_m: Annotated[
        float, typer.Option(min=0.01, max=1000, help="sigma of the priors' position, m")
    ] = 5.0,
    prior_sigma_deg: Annotated[
        float, typer.Option(min=0.01, max=180, help="sigma of the priors' attitude, degrees")
    ] = 4.0,
    attitude_sigma_deg: Annotated[
        float | None,
        typer.Option(
            min=0.05,
            max=20,
            help="sigma of the priors' roll and pitch, degrees, if measured",
        ),
    ] = None,
    height_sigma_m: Annotated[
        float | None,
        typer.Option(min=0.05, max=100, help="sigma of the priors' height, m, if it is measured"),
    ] = None,
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("localized"),
    rate_hz: Annotated[
        float, typer.Option(min=0.001, max=1000, help="frame rate of images without timestamps.txt")
    ] = 30.0,
    width: WorkingWidth = 320,
    renderer: Renderer = "auto",
    device: Device = "auto",
    model: FeatureNetwork = None,
) -> None:
    """Localize images against a map. Exit code 1: none was localized."""
    if not images.exists():
        raise ConfigError(f"{images}: no such image or folder")
    paths = list_images(images) if images.is_dir() else [images]
    cache = TileCache.open(
        map_cache
    )  # paths first: what is missing is said before anything is computed
    intrinsics = Camera.from_json(camera)
    if (prior is None) == (priors is None):
        raise ConfigError(
            "give either --prior LAT,LON,HEIGHT,ROLL,PITCH,YAW (of the first image; degrees, "
            "metres above the ellipsoid, pitch 0 looks straight down, yaw counter-clockwise from "
            "north) or --priors FILE (lines of: name lon lat alt roll pitch yaw)"
        )
    rows = read_poses(priors) if priors is not None else [_row(paths[0].name, str(prior))]
    if paths[0].name not in {row.name for row in rows}:
        raise ConfigError(f"--priors {priors}: has no line for the first image, {paths[0].name}")
    make_folder(out, "--out")
    for name in (*TRAJECTORY_NAMES, "images.csv"):
        refuse_input(out / name, "--out", priors, camera, *paths)
    sigmas = Sigmas(prior_sigma_m, prior_sigma_deg, attitude_sigma_deg, height_sigma_m)
    config = sigmas.config(
        LocalizerConfig(
            width=width, model=model, renderer=renderer, device=device, feature_threads=2
        )
    )
    times = image_times(paths, rate_hz)
    known: Mapping[str, Pose] = {row.name: world_from_camera(row, cache.frame) for row in rows}
    dated = zip(paths, times, strict=True)
    sensors = sensors_of({t: known[path.name] for path, t in dated if path.name in known})
    count = show_count(Console(stderr=True), "localizing", begins=COMPILES)
    with open_localizer(map_cache, intrinsics, config, sensors) as localizer, count as show:
        frame = localizer.frame
        more = tally(show, len(paths))
        found = []
        for one in localize_images(localizer, paths, times, intrinsics, known, sigmas):
            found.append(one)
            more()
    accepted = _print(found, frame)
    with writing(out, "--out"):
        _write(out, found, frame)
    raise typer.Exit(0 if accepted else 1)


def _row(name: str, prior: str) -> PoseRow:
    lat, lon, height, roll, pitch, yaw = numbers(
        prior, "--prior", ("LAT", "LON", "HEIGHT", "ROLL", "PITCH", "YAW")
    )
    return PoseRow(name, Geodetic(lat, lon, height), roll, pitch, yaw)


def _print(found: Sequence[LocalizedImage], frame: LocalFrame) -> int:
    """Print the position of a single image, or how many of several were localized."""
    tell_notes(f"{image.name}: {image.problem}" for image in found if image.problem)
    estimates = [i.estimate for i in found if i.estimate is not None and i.estimate.accepted]
    if len(found) == 1 and estimates:
        position, sigma = (
            frame.position(estimates[0].world_from_camera.translation),
            _sigmas(estimates[0]),
        )
        typer.echo(
            f"{position.latitude_deg:.7f} {position.longitude_deg:.7f} {position.height_m:.2f} m "
            f"above the ellipsoid, sigma {sigma[0]:.2f} {sigma[1]:.2f} {sigma[2]:.2f} m "
            f"east north up, {sigma[3]:.3f}° of attitude"
        )
    typer.echo(f"{len(estimates)} of {len(found)} images localized")
    return len(estimates)


def _sigmas(estimate: PoseEstimate) -> list[float]:
    """Sigmas: east, north, up (m), and the largest of the attitude (degrees)."""
    sigma = np.sqrt(estimate.covariance.diagonal())
    return [*(float(x) for x in sigma[:3]), float(np.degrees(sigma[3:].max()))]


def _write(folder: Path, found: Sequence[LocalizedImage], frame: LocalFrame) -> None:
    used = [
        to_stamped_pose(i.name, i.estimate)
        for i in found
        if i.estimate is not None and i.estimate.accepted
    ]
    write_trajectory(folder, used, frame)
    with (folder / "images.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(_csv_row(image, frame) for image in found)


def _csv_row(image: LocalizedImage, frame: LocalFrame) -> dict[str, str]:
    row = dict.fromkeys(COLUMNS, "") | {"name": image.name, "problem": image.problem}
    estimate = image.estimate
    if estimate is None:
        return row
    position = frame.position(estimate.world_from_camera.translation)
    sigma = [f"{x:.4f}" for x in _sigmas(estimate)]
    return (
        row
        | dict(zip(COLUMNS[4:8], sigma, strict=True))
        | {
            "latitude_deg": f"{position.latitude_deg:.9f}",
            "longitude_deg": f"{position.longitude_deg:.9f}",
            "height_m": f"{position.height_m:.3f}",
            "quality": f"{estimate.quality:.3f}",
            "state": estimate.state.value,
            "status": estimate.status.name,
            "accepted": str(int(estimate.accepted)),
        }
    )
