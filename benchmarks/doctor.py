"""How long `companion doctor` takes on a healthy vehicle, and how soon it says what it does.

    python -m benchmarks.doctor SEQUENCE [--fc embedded] [--rounds 1] [--out FILE.json]

The vehicle is simulated, as the demo's before take-off, on the demo's world (generated once, in
minutes); SEQUENCE, of `python -m sitl sequence`, is the feed. Wall time: of an idle machine.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

import yaml

from benchmarks.common.arguments import Parser, existing, output, whole
from benchmarks.common.named_errors import named_errors
from localizer.geometry.camera import Camera
from sitl.demo.assets import FlightAssets, prepare
from sitl.demo.flight import home_of, vehicle_parameters
from sitl.demo.scenario import Scenario
from sitl.ground.pilot import Pilot
from sitl.vehicles.launch import VehicleSetup, open_vehicle

FIRST_WORD_S, END_S = 5.0, 15.0
Kind = Literal["embedded", "ardupilot"]


def examine(deployment: Path) -> dict[str, Any]:
    """One examination: seconds to the first line, to the end, the steps and how it ended."""
    command = [sys.executable, "-u", "-m", "companion", "doctor", str(deployment)]
    begun_s, first_s, lines = time.monotonic(), None, []
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            first_s = first_s or time.monotonic() - begun_s
            lines.append(f"{time.monotonic() - begun_s:6.2f} {line.rstrip()}")
    end_s = time.monotonic() - begun_s
    return {"first_s": first_s, "end_s": end_s, "exit_code": process.returncode, "lines": lines}


def deployment(folder: Path, sequence: Path, assets: FlightAssets, endpoint: str) -> Path:
    """As an operator's, for that vehicle and feed."""
    scenario = Scenario()
    config = {
        "map": str(assets.map_cache),
        "camera": {
            "source": str((sequence / "images").resolve()),
            "model": Camera.from_json(sequence / "camera.json").to_dict(),
        },
        "bridge": {
            "connection": endpoint, "mode": "inject",
            "injection": {"delay_ms": scenario.injection_delay_ms},
        },
        "record": {"folder": str(folder / "flights" / "flight")},
    }  # fmt: skip
    path = folder / "deployment.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def measure(kind: Kind, sequence: Path, rounds: int) -> list[dict[str, Any]]:
    """Examine a vehicle that is ready to fly, so often."""
    assets = prepare(
        0, progress=lambda phase, share: print(f"{phase} {share:.0%}", file=sys.stderr)
    )
    with tempfile.TemporaryDirectory(prefix="doctor-") as name, contextlib.ExitStack() as stack:
        setup = VehicleSetup(parameters=vehicle_parameters(Scenario()))
        vehicle = stack.enter_context(open_vehicle(kind, home_of(assets), setup))
        pilot = stack.enter_context(Pilot(vehicle.gcs_endpoint, alive=vehicle.check))
        with pilot.fast_forward():
            pilot.wait_ready()
        path = deployment(Path(name), sequence, assets, vehicle.companion_endpoint)
        return [{"vehicle": kind} | examine(path) for _ in range(rounds)]


def table(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Columns and rows of text."""
    rows = [
        [run["vehicle"], f"{run['first_s']:.1f}", f"{run['end_s']:.1f}", str(run["exit_code"])]
        for run in runs
    ]
    limits = ["limit", f"<= {FIRST_WORD_S:g}", f"<= {END_S:g}", "0 or 1"]
    return {"columns": ["doctor on", "first line, s", "end, s", "exit"], "rows": [limits, *rows]}


def main() -> None:
    """Measure, print, write."""
    parser = Parser(__doc__)
    parser.add_argument("sequence", type=existing, help="folder of `python -m sitl sequence`")
    parser.add_argument("--fc", choices=("embedded", "ardupilot"), default="embedded", help="which")
    parser.add_argument("--rounds", type=whole(1, 20), default=1, help="examinations")
    parser.add_argument("--out", type=output, help="JSON file")
    options = parser.parse_args()
    runs = measure(options.fc, options.sequence, options.rounds)
    if options.out is not None:
        options.out.write_text(json.dumps(table(runs) | {"runs": runs}, indent=1))
    print("\n".join(runs[-1]["lines"]))
    for run in runs:
        print(
            f"{run['vehicle']}: first line after {run['first_s']:.1f} s (limit {FIRST_WORD_S:g}), "
            f"end after {run['end_s']:.1f} s (limit {END_S:g}), exit code {run['exit_code']}"
        )


if __name__ == "__main__":
    with named_errors():
        main()
