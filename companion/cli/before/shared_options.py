"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
