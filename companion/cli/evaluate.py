"""``companion eval``: localize a recorded sequence and print the paper's Table 2 columns."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console
from rich.text import Text

from companion.cli.before.shared_options import Device, FeatureNetwork, Renderer, WorkingWidth
from companion.cli.output import show_table, tell, tell_notes
from companion.errors import ConfigError
from companion.recorded.footage import FootageOptions, read_footage
from companion.recorded.sequence import sequence_of
from companion.reporting.report import write_page
from companion.terminal.steps import COMPILES, file_link, show_count, tally
from companion.trajectory import to_stamped_pose, write_trajectory
from companion.versions import made_by
from companion.writing import make_folder, refuse_input, writing
from localizer.config import LocalizerConfig
from localizer.evaluation.places import DrawnSensors, PlaceFinder, SimulatedPlaceData
from localizer.evaluation.sequences import (
    CSV_COLUMNS,
    EvaluatedFrame,
    LocalizationMetrics,
    Perturbation,
    PriorMode,
    Sequence,
    csv_rows,
    evaluate,
    worst_first,
)
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.trajectory import StampedPose, write_tum
from localizer.pictures import write_rgb
from localizer.relocalization.relocalizer import open_relocalizer
from localizer.render.base import MapRenderer
from localizer.tracking.opening import MapStack, build_localizer
from localizer.tracking.pipeline import Undistorter

_OVERLAYS = 4
_PROBLEMS = 5  # texts that are printed


def evaluate_command(
    sequence: Annotated[
        Path,
        typer.Argument(
            help="folder: images/, poses.txt, camera.json; or footage whose tags are the truth"
        ),
    ],
    map_cache: Annotated[Path, typer.Option("--map", help="tile cache")],
    report: Annotated[Path, typer.Option(help="folder of the report")] = Path("eval-report"),
    name: Annotated[str | None, typer.Option(help="sequence of the PiLoT data set")] = None,
    prior: Annotated[
        Literal["first", "each", "lost", "none"],
        typer.Option(
            help="approximate pose of: first, the first frame; each, every frame; lost, the first, "
            "100 to 500 m off; none: search"
        ),
    ] = "first",
    known_heading: Annotated[
        bool,
        typer.Option("--known-heading", help="lost and none: heading known to 15 degrees"),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="seed of the prior's noise")] = 0,
    noise_m: Annotated[
        float, typer.Option(min=0, max=1e6, help="largest error of the prior's position, m")
    ] = 10.0,
    noise_deg: Annotated[
        float, typer.Option(min=0, max=180, help="largest error of the prior's angles, degrees")
    ] = 10.0,
    attitude_sigma_deg: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=45,
            help="also use roll and pitch, with random errors of this sigma, degrees",
        ),
    ] = None,
    height_sigma_m: Annotated[
        float | None,
        typer.Option(
            min=0.01, max=1000, help="also use height, with random errors of this sigma, m"
        ),
    ] = None,
    width: WorkingWidth = 320,
    renderer: Renderer = "auto",
    device: Device = "auto",
    model: FeatureNetwork = None,
    limit: Annotated[int | None, typer.Option(min=1, help="only the first N frames")] = None,
) -> None:
    """Localize every frame of a recorded sequence from a perturbed prior and measure it."""
    searched = prior in ("lost", "none")
    if known_heading and not searched:
        raise ConfigError("--known-heading goes with --prior lost or none")
    refuse_input(report, "--report", sequence)
    _prepare(report)
    mode: PriorMode = "each" if prior == "each" else "first"
    sensors = DrawnSensors(attitude_sigma_deg, height_sigma_m, prior == "each", seed)
    config = sensors.config(
        LocalizerConfig(
            width=width, model=model, seed=seed, renderer=renderer, device=device, feature_threads=2
        )
    )
    counting = show_count(Console(stderr=True), "localizing", begins=COMPILES)
    with ExitStack() as progress:
        show = progress.enter_context(counting)
        stack = MapStack(map_cache, config)
        try:
            flight = read_footage(sequence, FootageOptions(report, sys.maxsize, name=name))
            data = sequence_of(flight, stack.cache.frame, stack.cache.manifest.geoid_separation_m)
            data = data if limit is None else data.first(limit)
            notes = list(flight.notes)
            if not data.is_timed and prior != "each":
                notes.append(f"{sequence}: its times do not increase: 30 frames/s assumed")
            tell_notes(notes)
            localizer = build_localizer(stack, data.camera, config, sensors.auxiliary(data))
            known = None
            if searched:
                known = SimulatedPlaceData(
                    prior == "lost", known_heading, attitude_sigma_deg or 0.7,
                    height_sigma_m or 2.0, seed,
                )  # fmt: skip
            with place_finder(stack, config, known) as find:
                frames, metrics = evaluate(
                    localizer,
                    data,
                    Perturbation(noise_m, noise_deg, seed, sensors.in_prior),
                    mode,
                    progress=tally(show, len(data.images)),
                    find=find,
                )
            progress.close()  # before the tables are printed
            settings = {
                "sequence": str(sequence), "map": str(map_cache), "prior": prior, "seed": seed,
                "known_heading": known_heading,
                "noise_m": noise_m, "noise_deg": noise_deg,
                "attitude_sigma_deg": attitude_sigma_deg, "height_sigma_m": height_sigma_m,
                "width": localizer.camera.width,
                "height": localizer.camera.height, "features": load_extractor(model).name,
                "renderer": stack.renderer.name, "optimizer": localizer.optimizer_name,
            }  # fmt: skip
            _print_problems(frames)
            unusable = sum(f.unusable for f in frames)
            # Before the files: they are told even if the disk is full.
            print_metrics(metrics, unusable, str(sequence))
            with writing(report, "--report"):
                _write_report(report, frames, metrics, settings, stack.cache.frame)
                _write_trajectories(report, frames, data, stack.cache.frame)
                _write_overlays(report, frames, data, stack.renderer, localizer.camera)
        finally:
            stack.close()
    page = write_page(report)
    tell(Text.assemble("report: ", file_link(page)))


@contextmanager
def place_finder(
    stack: MapStack, config: LocalizerConfig, known: SimulatedPlaceData | None
) -> Iterator[PlaceFinder | None]:
    """Context manager: the search for a position without a prior; None if `known`, the simulated
    knowledge of the place, is None. Opens or computes the map's overview.
    """
    opened = None if known is None else open_relocalizer(stack.cache, config)
    if known is None or opened is None:
        yield None
        return
    with opened as relocalizer:
        yield PlaceFinder(relocalizer, known)


def _print_problems(frames: list[EvaluatedFrame]) -> None:
    problems = [f.problem for f in frames if f.problem]
    tell_notes(problems[:_PROBLEMS])
    if len(problems) > _PROBLEMS:
        tell_notes([f"... {len(problems) - _PROBLEMS} more: see frames.csv"])


def print_metrics(metrics: LocalizationMetrics, unusable: int, title: str) -> None:
    """Print the columns of the paper's Table 2, with the number of unusable images."""
    m = metrics
    columns = ("frames", "unusable", "Med m", "Med °", "R@1", "R@3", "R@5", "Comp. %", "FPS")
    row = (
        str(m.frames), str(unusable),
        _text(m.median_translation_m, 2), _text(m.median_rotation_deg, 3),
        f"{m.recall_1:.1f}", f"{m.recall_3:.1f}", f"{m.recall_5:.1f}",
        f"{m.completeness:.1f}", f"{m.fps:.1f}",
    )  # fmt: skip
    show_table(columns, [row], title, columns)
    tell("medians of localized frames; recalls and completeness of all")
    tell(
        f"p95 {_text(m.p95_translation_m, 2)} m {_text(m.p95_rotation_deg, 3)}°, "
        f"maximum {_text(m.max_translation_m, 2)} m {_text(m.max_rotation_deg, 3)}° "
        "of localized frames"
    )


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _prepare(folder: Path) -> None:
    """Create the report's folder and check that it is writable, before the long computation."""
    with writing(make_folder(folder, "--report"), "--report"), TemporaryFile(dir=folder):
        pass


def _write_report(
    folder: Path,
    frames: list[EvaluatedFrame],
    metrics: LocalizationMetrics,
    settings: dict[str, object],
    local: LocalFrame,
) -> None:
    unusable = [f.name for f in frames if f.unusable]
    report = asdict(metrics) | {
        "unusable_images": unusable, "settings": settings, "versions": made_by()
    }  # fmt: skip
    (folder / "report.json").write_text(json.dumps(report, indent=2))
    with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, CSV_COLUMNS)
        writer.writeheader()
        writer.writerows(csv_rows(frames, local))


def _write_trajectories(
    folder: Path, frames: list[EvaluatedFrame], data: Sequence, local: LocalFrame
) -> None:
    """Write localized poses and the truth, for ``evo_ape tum truth.tum trajectory.tum``."""
    estimates = [(f.name, f.estimate) for f in frames if f.estimate is not None]
    write_trajectory(folder, [to_stamped_pose(n, e) for n, e in estimates if e.accepted], local)
    names = (path.name for path in data.images)
    truth = map(StampedPose, names, data.truth, data.times_ns)
    write_tum(folder / "truth.tum", truth)


def _shown(frames: list[EvaluatedFrame]) -> list[int]:
    """Indices of the worst frames; at most half of them rejected, if others were localized."""
    order = worst_first(frames)
    rejected = [i for i in order if frames[i].translation_error_m is None]
    localized = [i for i in order if frames[i].translation_error_m is not None]
    few = rejected[: max(_OVERLAYS // 2, _OVERLAYS - len(localized))]
    return localized[: _OVERLAYS - len(few)] + few


def _write_overlays(
    folder: Path,
    frames: list[EvaluatedFrame],
    data: Sequence,
    renderer: MapRenderer,
    camera: Camera,
) -> None:
    """Write images of the worst frames beside the map rendered at their estimated poses."""
    undistort = Undistorter(data.camera, camera)
    for i in _shown(frames):
        estimate = frames[i].estimate
        if estimate is None:
            continue
        view = renderer.render(estimate.world_from_camera, camera, wait=True)
        video = undistort(data.frame(i))
        write_rgb(folder / f"overlay-{i:04d}.png", np.hstack([video, view.rgb]))
