"""What a command is doing goes to standard error, what it found to standard output."""

from __future__ import annotations

from pathlib import Path

import yaml
from typer.testing import CliRunner

from companion.cli.commands import app
from tests.companion.test_config import MINIMAL


def test_doctors_table_stands_alone_on_standard_output(tmp_path: Path) -> None:
    file = tmp_path / "d.yaml"
    file.write_text(yaml.safe_dump(MINIMAL | {"map": str(tmp_path / "none")}))
    done = CliRunner().invoke(app, ["doctor", str(file), "--beside-flight"])
    assert done.exit_code == 2
    assert "NOT fit to fly" in done.stdout
    assert "examining" not in done.stdout
    assert "examining" in done.stderr
