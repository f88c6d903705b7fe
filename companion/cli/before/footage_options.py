"""Options of every command that reads footage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

FootageCamera = Annotated[
    Path | None, typer.Option(help="camera.json; default: the footage's tags")
]
FieldOfView = Annotated[
    float | None, typer.Option(min=1, max=170, help="horizontal field of view, degrees")
]
MountPitch = Annotated[
    float, typer.Option(min=-180, max=180, help="pitch of a fixed camera, degrees; -90 looks down")
]
