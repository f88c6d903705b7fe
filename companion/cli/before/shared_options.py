"""Options that several commands have, and the parser of those with several numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from companion.errors import ConfigError
from localizer.registration.devices import DeviceChoice
from localizer.render.select import RendererName

FootageCamera = Annotated[
    Path | None, typer.Option(help="camera.json; default: the footage's tags")
]
FieldOfView = Annotated[
    float | None, typer.Option(min=1, max=170, help="horizontal field of view, degrees")
]
MountPitch = Annotated[
    float, typer.Option(min=-180, max=180, help="pitch of a fixed camera, degrees; -90 looks down")
]
WorkingWidth = Annotated[int, typer.Option(min=64, max=2048, help="working width, pixels")]
Renderer = Annotated[
    RendererName, typer.Option(help="auto: a GPU if there is one, otherwise numba")
]
Device = Annotated[
    DeviceChoice,
    typer.Option(help="runs the optimizer; auto, cuda: a working GPU, otherwise the CPU"),
]
FeatureNetwork = Annotated[Path | None, typer.Option(help="ONNX feature network")]
Record = Annotated[Path, typer.Argument(help="folder that `companion run` recorded")]
RecordTlog = Annotated[Path | None, typer.Option(help="instead of the record's bridge.tlog")]
RecordMap = Annotated[Path | None, typer.Option("--map", help="instead of the record's map")]


def numbers(text: str, option: str, names: Sequence[str]) -> tuple[float, ...]:
    """Parse the text of an option, as 47.1,8.5,500; `names`: meanings of the numbers, one each.
    `ConfigError` for another count, or what is no finite number.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(names) or not all(map(math.isfinite, values)):
        raise ConfigError(f"{option} is {','.join(names)}, {len(names)} numbers, not {text!r}")
    return values
