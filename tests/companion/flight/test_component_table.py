"""What the table's parts are made of a deployment as it comes."""

from __future__ import annotations

import os
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

from companion.config import load_config
from companion.conversions import CameraExtrinsics
from companion.flight.component_table import COMPONENTS
from companion.flight.components import Assembly, BuildContext, Component
from companion.flight.injection import FixInjection
from companion.inertial import InertialTrack
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from mavlink_bridge.bridge import Bridge

MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}


def _given(one: Any, _: BuildContext) -> Any:
    return one


def test_the_guardian_is_made_of_a_deployment_in_a_folder_whose_name_is_no_utf8(tmp_path: Path):
    """No flight began there: what the monitor remembers is of the camera, by its film's path."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/fl\xfcge"))
    folder.mkdir()
    deployment = folder / "companion.yaml"
    camera = {"source": "film.mp4", "model": MODEL}
    record = {"folder": "record"}
    deployment.write_text(yaml.safe_dump({"map": "m", "camera": camera, "record": record}))
    stand_ins = {
        Bridge: object(), CameraExtrinsics: object(), InertialTrack: object(),
        FixInjection: SimpleNamespace(add_check=lambda _: None, add_observer=lambda _: None),
    }  # fmt: skip
    parts: list[Component[Any]] = [
        Component(kind.__name__, kind, partial(_given, one)) for kind, one in stand_ins.items()
    ]
    assembly = Assembly(
        load_config(deployment), [*parts, *(p for p in COMPONENTS if p.kind is IntegrityMonitor)]
    )
    with ExitStack() as up:
        assembly.make(up)
        assert assembly.get(IntegrityMonitor) is not None
