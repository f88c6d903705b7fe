"""The table of parts: made and started in order, undone in the reverse, whatever fails."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from companion.calibration_watch.map_offset import MapOffsetEstimator
from companion.config import load_config, parse_config
from companion.conversions import CameraExtrinsics
from companion.flight.channels import Channel, Feed, FixInjection
from companion.flight.component_table import COMPONENTS
from companion.flight.components import Assembly, Component
from companion.inertial import InertialTrack
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from mavlink_bridge.bridge import Bridge

MODEL = {"width": 160, "height": 120, "fx": 140, "fy": 140, "cx": 80, "cy": 60}


class Lower:
    pass


class Upper:
    pass


def _config(**bridge):
    settings = {"map": "m", "camera": {"source": "s", "model": MODEL}, "bridge": bridge}
    return parse_config(settings, "test")


def _part(log, kind, make=None, **columns):
    def note(what):
        return lambda _: log.append(f"{what} {kind.__name__}")

    def made(making):
        log.append(f"make {kind.__name__}")
        return (make or (lambda _: kind()))(making)

    steps = {step: note(step) for step in ("start", "stop", "close")}
    return Component(kind.__name__, kind, made, **{**steps, **columns})


def test_all_are_made_before_the_first_starts_and_undone_in_the_reverse():
    log: list[Any] = []
    assembly = Assembly(_config(), [_part(log, Lower), _part(log, Upper)])
    with ExitStack() as up:
        assembly.make(up)
        assembly.start(up)
    assert log == [
        "make Lower", "make Upper", "start Lower", "start Upper",
        "stop Upper", "stop Lower", "close Upper", "close Lower",
    ]  # fmt: skip


def test_a_part_that_cannot_be_made_closes_those_before_it():
    def fail(_):
        raise OSError("no")

    log: list[Any] = []
    assembly = Assembly(_config(), [_part(log, Lower), _part(log, Upper, fail)])
    with pytest.raises(OSError, match="no"), ExitStack() as up:
        assembly.make(up)
    assert log == ["make Lower", "make Upper", "close Lower"]


@pytest.mark.parametrize("ask", [Assembly.__getitem__, Assembly.get])
def test_a_part_that_stands_below_is_asked_later(ask):
    log: list[Any] = []
    later = _part(log, Lower, lambda making: (making.later(Upper), Lower())[1])
    at_once = _part(log, Lower, lambda making: (ask(making, Upper), Lower())[1])
    with ExitStack() as up:
        Assembly(_config(), [later, _part(log, Upper)]).make(up)
    with ExitStack() as up, pytest.raises(LookupError, match="Upper"):
        Assembly(_config(), [at_once, _part(log, Upper)]).make(up)
    with ExitStack() as up, pytest.raises(LookupError, match=r"no component builds .*Upper"):
        Assembly(_config(), [later]).make(up)


def test_what_is_not_wanted_is_not_made():
    log: list[Any] = []
    parts = [
        _part(log, Lower, wanted=lambda config: config.bridge.camera.announce),
        _part(log, Upper, lambda making: making.get(Lower) or Upper()),
    ]
    with ExitStack() as up:
        Assembly(_config(camera={"announce": False}), parts).make(up)
    assert log == ["make Upper", "close Upper"]


def test_the_process_starts_and_stops_in_this_order():
    """The bridge speaks before anything could have something to say, the feed comes last."""
    started = [part.name for part in COMPONENTS if part.start is not None]
    assert started == [
        "bridge", "integrity monitor", "record", "klv", "health", "targets", "detector",
        "last fix", "view", "vital signs", "search",
        "console", "engine", "feed",
    ]  # fmt: skip
    made = [part.name for part in COMPONENTS]
    # A wrong source and a port in use are told before anything is compiled.
    assert made.index("source") < made.index("detections") < made.index("localizer")


def test_every_subscriber_is_served_though_one_fails():
    channel: Channel[Any] = Channel()
    taken: list[Any] = []

    def fail(_):
        raise ValueError("boom")

    channel.subscribe(fail)
    channel.subscribe(taken.append)
    with pytest.raises(ValueError, match="boom"):
        channel.send(1)
    assert taken == [1]


# --- What the table's parts are made of a deployment as it comes --------------------------------


def _given(one: Any, _: Assembly) -> Any:
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


@pytest.mark.parametrize("policy", ["tell", "apply"])
def test_fixes_are_corrected_by_the_maps_offset_only_where_that_is_wanted(policy):
    checks: list[Any] = []
    observers: list[Any] = []
    fixes = SimpleNamespace(add_check=checks.append, add_observer=observers.append)
    config = _config(connection="tcp:127.0.0.1:5763", injection={"map_shift": policy})
    parts: list[Component[Any]] = [
        Component("bridge", Bridge, partial(_given, object())),
        Component("injection", FixInjection, partial(_given, fixes)),
        *(part for part in COMPONENTS if part.kind is MapOffsetEstimator),
    ]
    assembly = Assembly(config, parts)
    with ExitStack() as up:
        assembly.make(up)
    shift = assembly[MapOffsetEstimator]
    assert checks == ([shift.corrected] if policy == "apply" else [])
    assert len(observers) == 1


# --- The feed hands frames on, whatever becomes of them -----------------------------------------


class Source:
    """Three frames; then its regular end, or an error."""

    def __init__(self, error: Exception | None = None) -> None:
        self._error = error

    def frames(self) -> Iterator[Any]:
        yield from range(3)
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        pass


def fed(source: Source, take: Any) -> Feed:
    feed = Feed(source, take)  # type: ignore[arg-type]
    feed.start()
    assert feed.ended.wait(20.0)
    feed.stop()
    return feed


def test_a_part_that_fails_on_a_frame_does_not_end_the_flight(caplog):
    """One picture that the console or a recorder could not take ended the process in the air."""
    taken: list[int] = []

    def take(frame: int) -> None:
        taken.append(frame)
        if frame < 2:
            raise ValueError(f"frame {frame}")

    feed = fed(Source(), take)
    assert taken == [0, 1, 2]
    assert feed.error is None
    assert feed.failures == 2
    assert len([r for r in caplog.records if "a part failed" in r.getMessage()]) == 1


def test_what_ends_the_source_is_kept() -> None:
    assert isinstance(fed(Source(OSError("gone")), lambda _: None).error, OSError)
