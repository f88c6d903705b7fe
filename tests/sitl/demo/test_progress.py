"""Progress in a log: a line per phase, and one every ten seconds of a long one."""

from __future__ import annotations

import pytest

from localizer.map.cache.cache import TileCache
from localizer.synth.world import WorldInfo
from sitl.demo import assets


def test_a_world_that_is_being_made_tells_how_far_it_is(tmp_path, monkeypatch) -> None:
    def build_visits(config, visits, progress) -> None:
        progress(0.5)
        progress(1.0)

    def build_cache(source, out, progress) -> None:
        progress(1, 2)
        progress(2, 2)

    monkeypatch.setattr(assets, "build_visits", build_visits)
    monkeypatch.setattr(assets, "build_cache", build_cache)
    monkeypatch.setattr(TileCache, "open", lambda _: None)
    monkeypatch.setattr(WorldInfo, "load", lambda _: None)
    told: list[tuple[str, float]] = []
    for _ in range(2):  # the second time it is there
        assets.prepare(3, tmp_path, lambda *what: told.append(what), ideal=True)
    phases = ["generating world 3 (a few minutes, once)"] * 3
    phases += ["importing the survey tileset"] * 2 + ["importing the live tileset"] * 2
    assert [phase for phase, _ in told] == phases
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert [shares[0], shares[-1]] == pytest.approx([0.0, 1.0])
