"""Records that cannot be written and keys that cannot be read are told before the start."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from companion.config import parse_config
from companion.preflight.places import check_places
from mavlink_bridge.link.signing import create_key

MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}


def faults(**settings: Any) -> list[str]:
    camera = {"source": "udp://127.0.0.1:5600", "model": MODEL}
    config = parse_config({"map": "cache", "camera": camera} | settings, "test")
    found = check_places(config)
    assert all(f.required and not f.ok for f in found)
    return [f.why for f in found]


@pytest.mark.parametrize("below", ["x", "x/y/z"])
def test_a_record_below_a_file_is_told(tmp_path: Path, below: str) -> None:
    (tmp_path / "file").write_text("")
    (why,) = faults(record={"folder": str(tmp_path / "file" / below)})
    assert why.startswith("record.folder")
    assert why.endswith("is not a folder")


def test_a_name_that_no_disk_takes_is_told(tmp_path: Path) -> None:
    name = str(tmp_path / ("x" * 300))
    (record,) = faults(record={"folder": name})
    (tlog,) = faults(bridge={"tlog": name})
    assert "record.folder" in record
    assert "bridge.tlog" in tlog


def test_a_folder_in_place_of_a_file_is_told(tmp_path: Path) -> None:
    (why,) = faults(bridge={"tlog": str(tmp_path)})
    assert why == f"bridge.tlog {tmp_path}: a folder, not a file"


def test_a_signing_key_that_is_not_there_is_told(tmp_path: Path) -> None:
    (why,) = faults(bridge={"signing": {"key_file": str(tmp_path / "none.key")}})
    assert "bridge.signing" in why
    assert "none.key" in why


def test_what_a_start_makes_itself_is_no_fault(tmp_path: Path) -> None:
    create_key(tmp_path / "mavlink.key")
    assert not faults(
        record={"folder": str(tmp_path / "flights/flight")},
        state_dir=str(tmp_path / "state"),
        bridge={
            "tlog": str(tmp_path / "flights/latest.tlog"),
            "signing": {"key_file": str(tmp_path / "mavlink.key")},
        },
    )
    assert {path.name for path in tmp_path.iterdir()} == {"mavlink.key"}


def test_what_the_page_reads_and_is_no_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("x")
    assert not faults(console={"token_file": str(tmp_path / "token")})
    (why,) = faults(console={"token_file": "/dev/zero"})
    assert why == "console.token_file /dev/zero: is no file"
