"""``companion init``: make a deployment file from vehicle, stream and map."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import typer
from rich.console import Console
from rich.markup import escape

from companion.cli.output import tell
from companion.config import CompanionConfig, parse_config
from companion.errors import CompanionError, ConfigError, redacted
from companion.terminal.steps import show_work
from companion.writing import result_file
from localizer.errors import LocalizerError
from mavlink_bridge.errors import BridgeError

_DEFAULT_FOV_DEG = 65.0
_NO_MAP = Path("maps/area")  # where the map is to lie, until there is one
_Answer = TypeVar("_Answer", str, float)


def init_command(
    out: Annotated[Path, typer.Argument(help="deployment file to write")] = Path("deployment.yaml"),
    map_cache: Annotated[Path | None, typer.Option("--map", help="tile cache")] = None,
    source: Annotated[
        str | None, typer.Option(help="video: udp://, rtsp://, /dev/videoN, a file or a folder")
    ] = None,
    connection: Annotated[
        str | None, typer.Option(help="autopilot: serial:/dev/ttyTHS1:921600, udpin:HOST:PORT, ...")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="camera.json of the calibration; without it --fov")
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(
            min=1, max=170, help="horizontal field of view, degrees, without a calibration"
        ),
    ] = None,
    mount: Annotated[
        Literal["gimbal", "fixed"] | None, typer.Option(help="fixed: screwed to the airframe")
    ] = None,
    mount_pitch: Annotated[
        float,
        typer.Option(min=-180, max=180, help="pitch of a fixed camera, deg; -90 looks down"),
    ] = -90.0,
    record: Annotated[Path, typer.Option(help="folder of the flights' records")] = Path("flights"),
    listen: Annotated[
        bool, typer.Option(help="read vehicle and stream; without it write only what is given")
    ] = True,
    overwrite: Annotated[bool, typer.Option(help="replace an existing file")] = False,
    reference: Annotated[
        bool, typer.Option("--reference", help="print every setting with its default and exit")
    ] = False,
) -> None:
    """Ask for map, stream and vehicle, read their settings, and write a short deployment file."""
    from companion.setup.write import deployment_text, write_deployment
    from companion.setup.write import reference as all_settings

    if reference:
        typer.echo(all_settings(), nl=False)
        return
    result_file(out, "OUT", (".yaml", ".yml"), camera)
    if out.exists() and not overwrite:
        raise ConfigError(f"{out}: is there already; --overwrite replaces it")
    notes: list[str] = []
    settings = _map_settings(map_cache or _ask_map(), notes)
    feed = source or _ask("video source", "--source", "udp://0.0.0.0:5600")
    wire = connection or _ask("autopilot", "--connection", "serial:/dev/ttyTHS1:921600")
    mounted = mount or _ask("camera mount (gimbal, fixed)", "--mount", "gimbal")
    if camera is None and fov is None:
        fov = _ask("horizontal field of view, degrees", "--camera or --fov", _DEFAULT_FOV_DEG)
    size = None
    if listen:
        with show_work(Console(stderr=True), f"waiting for a frame of {redacted(feed)}"):
            size = _stream_size(feed, notes)
    placed = feed if "://" in feed else str(Path(feed).resolve())
    settings["camera"] = {"source": placed, "model": _model(camera, fov, size, notes)}
    bridge: dict[str, Any] = {"connection": wire, "camera": {"mount": mounted}}
    if mounted == "fixed":
        bridge["camera"]["mount_pitch_deg"] = mount_pitch
    settings["bridge"] = bridge
    settings["record"] = {"folder": str((record / "flight").resolve())}
    config = parse_config(settings, str(out))
    if listen:
        with show_work(Console(stderr=True), f"waiting for the autopilot at {wire}"):
            config = _with_vehicle(config, notes)
    write_deployment(deployment_text(config, notes), out, overwrite)
    for note in notes:
        tell(escape(note), "yellow")
    first = "" if config.map_sha256 else "the map, then "
    tell(f"{escape(str(out))} is written; next: {first}companion doctor {escape(str(out))}")


def _ask(what: str, option: str, default: _Answer | None = None) -> _Answer:
    """Ask the operator for `what`; ConfigError without a terminal, which names the option."""
    try:
        answer: _Answer = typer.prompt(what, default=default)
    except typer.Abort as error:
        if sys.stdin.isatty():  # he does not want to go on
            raise
        typer.echo(err=True)
        raise ConfigError(f"{what}: nobody answers here; give {option}") from error
    return answer


def _ask_map() -> Path | None:
    """Ask for the map's folder; None if there is no map yet, or no terminal."""
    try:
        answer = typer.prompt("map: folder of the tile cache (Enter: none yet)", default="",
                              show_default=False)  # fmt: skip
    except typer.Abort:
        if sys.stdin.isatty():  # he does not want to go on
            raise
        typer.echo(err=True)
        return None
    return Path(answer) if answer else None


def _map_settings(cache: Path | None, notes: list[str]) -> dict[str, Any]:
    """Path and hash of the map; without a map its later path, and a note that it is missing.
    MapCacheError if something else is there.
    """
    place = cache or _NO_MAP
    if cache is not None and cache.exists():
        return {"map": str(place.resolve()), "map_sha256": _map_hash(cache)}
    notes.append(
        f"NO MAP YET, nothing flies without one: {place} is not there; `companion map fetch` or "
        f"`companion map build` --out {place}, then map_sha256 from `companion map verify {place}`"
    )
    return {"map": str(place.resolve())}


def _map_hash(map_cache: Path) -> str:
    """Hash of the map; MapCacheError if there is no map."""
    from companion.preflight.map_pin import map_hash
    from localizer.map.cache.cache import TileCache

    manifest = TileCache.open(map_cache).manifest
    place = f"{manifest.origin.latitude_deg:.5f}, {manifest.origin.longitude_deg:.5f}"
    typer.echo(f"map: {manifest.tiles} tiles of {manifest.gsd_m:.2f} m texels about {place}")
    return map_hash(map_cache)


def _stream_size(feed: str, notes: list[str]) -> tuple[int, int] | None:
    from companion.setup.write import read_stream_size

    try:
        width, height = read_stream_size(feed)
    except (CompanionError, LocalizerError) as error:
        notes.append(f"the stream {redacted(feed)} gave no frame ({error}): check width, height")
        return None
    typer.echo(f"stream: {width}x{height}")
    return width, height


def _model(
    camera: Path | None, fov: float | None, size: tuple[int, int] | None, notes: list[str]
) -> dict[str, Any]:
    from localizer.geometry.camera import Camera

    if camera is not None:
        lens = Camera.from_json(camera)
        if size is not None and size != (lens.width, lens.height):
            notes.append(
                f"the stream is {size[0]}x{size[1]}, the calibration of {lens.width}x{lens.height} "
                "is scaled: wrong if the camera crops or zooms"
            )
        return lens.to_dict()
    width, height = size or (1280, 720)
    if size is None:
        notes.append(f"{width}x{height} is assumed: check width, height of camera.model")
    notes.append("camera.model is a field of view, not a calibration: docs/tutorials/my-camera.md")
    return Camera.from_fov(width, height, fov or _DEFAULT_FOV_DEG).to_dict()


def _with_vehicle(config: CompanionConfig, notes: list[str]) -> CompanionConfig:
    """The settings with the system id of the autopilot that answers; notes, if none does."""
    from mavlink_bridge.preflight.client import detect_autopilot

    try:
        met = detect_autopilot(config.bridge)
    except BridgeError as error:
        notes.append(f"no vehicle was heard ({error})")
        return config
    typer.echo(f"vehicle: {met.firmware}, system id {met.system_id}")
    if met.firmware != "ArduPilot":
        notes.append(
            f"{met.firmware}: choose bridge.injection.message by docs/reference/messages.md"
        )
    bridge = config.bridge.model_copy(update={"system_id": met.system_id})
    return config.model_copy(update={"bridge": bridge})
