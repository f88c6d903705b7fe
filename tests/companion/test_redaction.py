"""No password in what is logged, told or recorded."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.redaction import redacted
from companion.sources import SourceSettings, StreamState, open_source
from localizer.geometry.camera import Camera


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtsp://admin:s3cret@10.0.0.2:554/live", "rtsp://***@10.0.0.2:554/live"),
        ("rtsp://admin:p@ss/w0rd@10.0.0.2/live", "rtsp://***@10.0.0.2/live"),
        ("refused: 'rtsp://a:b@c/d'; again", "refused: 'rtsp://***@c/d'; again"),
        ("rtsp://c/d?user=admin&password=x", "rtsp://c/d?user=***&password=***"),
        ("udp://10.0.0.1:5600 and me@example.org", "udp://10.0.0.1:5600 and me@example.org"),
        ("udp://@239.1.1.1:5600", "udp://@239.1.1.1:5600"),
    ],
)  # fmt: skip
def test_credentials_are_hidden_and_nothing_else(text: str, shown: str) -> None:
    assert redacted(text) == shown


def test_a_feed_never_tells_its_password(caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []
    source: Any = None

    def on_state(state: StreamState, text: str) -> None:
        told.append(text)
        if state is StreamState.STALLED:
            source.close()

    url = "rtsp://admin:s3cret@127.0.0.1:9/none"
    source = open_source(url, Camera.from_fov(320, 240, 70.0), SourceSettings(), on_state)
    assert list(source.frames()) == []
    assert any("***@127.0.0.1" in text for text in told)
    assert "s3cret" not in "".join(told) + caplog.text


@pytest.fixture
def umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.mark.usefixtures("umask")
def test_what_a_flight_writes_is_not_for_everybody(tmp_path, monkeypatch):
    class Flying:
        def __init__(self, *_: object, **__: object) -> None:
            (tmp_path / "record").mkdir()

        def run(self) -> None:
            (tmp_path / "record" / "events.csv").write_text("x")

    monkeypatch.setattr("companion.flight.standby.Companion", Flying)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    deployment = Path(__file__).parents[2] / "configs" / "deployment.yaml"
    result = CliRunner().invoke(app, ["run", str(deployment)])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "record").stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "record" / "events.csv").stat().st_mode & 0o777 == 0o640
