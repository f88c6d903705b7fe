"""How far a map errs alike, from flights whose errors are drawn."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.protection.patches import FlightPositions, main, read_told, table
from companion.errors import RecordError


def told(length_m: float, seed: int = 0) -> FlightPositions:
    """Errors of a map in patches of a length, from 40 to 160 m, under 0.1 m of noise."""
    rng = np.random.default_rng(seed)
    shares = np.stack([np.eye(2) * (0.6 / height) ** 2 for height in rng.uniform(40, 160, 800)])
    covariances = np.broadcast_to(np.eye(2) * 0.01, shares.shape)
    roots = np.sqrt(covariances + length_m**2 * shares)
    errors = np.einsum("nij,nj->ni", roots, rng.standard_normal((800, 2)))
    return FlightPositions(f"flight-{seed}", errors, np.array(covariances), shares)


@pytest.mark.parametrize("length_m", [5.0, 20.0, 40.0])
def test_the_length_that_was_drawn_is_the_likeliest(length_m: float) -> None:
    flight = told(length_m)
    lengths = (2.5, 5.0, 10.0, 20.0, 40.0, 80.0)
    likeliest = max(lengths, key=lambda one: flight.judged(one)[1])
    assert likeliest == length_m
    assert flight.judged(length_m)[0] == pytest.approx(0.95, abs=0.02)


def test_flights_count_alike_in_the_last_rows() -> None:
    rows = table([told(5.0, 1), told(20.0, 2)], (5.0, 20.0))
    assert [row[0] for row in rows] == ["flight-1"] * 2 + ["flight-2"] * 2 + ["all"] * 2
    assert rows[-1][1:3] == ["1600", "20"]


def flown(folder: Path) -> Path:
    """A camera straight down, 60 m above take-off: ten positions 0.3 m off, told to 0.1 m."""
    record = folder / "companion"
    record.mkdir(parents=True)
    model = {"width": 640, "height": 480, "fx": 550, "fy": 550, "cx": 320, "cy": 240}
    config = {"map": "cache", "camera": {"source": "udp://127.0.0.1:5600", "model": model}}
    (folder / "companion.yaml").write_text(yaml.safe_dump(config))
    pose, down = "exposure_time_ns,east_m,north_m,up_m,qw,qx,qy,qz", "0.0,1.0,0.0,0.0"
    frames, estimates = f"{pose}\n1000000000,0,0,10,{down}\n", f"{pose},accepted,state\n"
    bounds = "name,exposure_time_ns,c00,c01,c11\n"
    for k in range(1, 11):
        time_ns = 1_000_000_000 + k * 100_000_000
        frames += f"{time_ns},{k},0,70,{down}\n"
        estimates += f"{time_ns},{k + 0.3},0,70,{down},1,tracking\n"
        bounds += f"{time_ns}.jpg,{time_ns},0.01,0.0,0.01\n"
    (folder / "frames.csv").write_text(frames)
    (record / "estimates.csv").write_text(estimates)
    (record / "covariances.csv").write_text(bounds)
    return folder


def test_a_flight_is_read_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = flown(tmp_path / "flight")
    out = tmp_path / "patches.json"
    arguments = ["patches", str(flight), "--recorded", "5", "--lengths", "5", "20"]
    monkeypatch.setattr("sys.argv", [*arguments, "--json", str(out)])
    main()
    rows = json.loads(out.read_text())["rows"]
    assert rows[0][:4] == ["flight", "10", "5", "0.0 %"]
    assert float(rows[0][5]) == 0.1 < float(rows[1][5]) < 0.3


@pytest.mark.parametrize("name", ["frames.csv", "companion/estimates.csv"])
def test_a_flight_without_rows_is_refused_by_name(name: str, tmp_path: Path) -> None:
    flight = flown(tmp_path / "flight")
    file = flight / name
    file.write_text(file.read_text().splitlines(keepends=True)[0])
    with pytest.raises(RecordError, match=r"flight: .* has no '\w+', or no rows"):
        read_told(flight, 5.0)
