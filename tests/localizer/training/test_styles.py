"""Seasons' styles: each changes what it should, and places drawn without them stay as they were."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from localizer.training.config import load_config
from localizer.training.data.pairs import SceneConfig, draw_visit, scene_pairs, visit_of
from localizer.training.data.streams import scene_config
from localizer.training.places.land import generated_place
from localizer.training.places.styles import LAMPS, STYLES, styled_ground

CONFIG = SceneConfig(
    cells=128, width=64, height=48, photo_share=0.0, cell_m=(0.5, 0.8), queries_per_light=1
)
# Conditions and mean grey levels of the generator before there were styles.
KEPT = [("day", 76.1), ("night", 112.8), ("day", 73.0), ("fog", 79.9)]


def test_places_drawn_without_styles_stay_as_they_were() -> None:
    """Kept results and training runs depend on them."""
    found = [
        (p.condition, float(p.query.mean()))
        for p in scene_pairs(7, replace(CONFIG, references=4), None)
    ]
    assert [c for c, _ in found] == [c for c, _ in KEPT]
    assert [m for _, m in found] == pytest.approx([m for _, m in KEPT], abs=0.3)


def test_every_style_is_a_condition_and_repeats() -> None:
    wanted = tuple(STYLES)
    config = replace(CONFIG, references=len(wanted), conditions=wanted)
    first, again = (list(scene_pairs(3, config, None)) for _ in range(2))
    assert len(first) == len(again) >= len(wanted) - 2  # chance may offer no view
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.query, b.query)
        assert a.query.std() > 1


def test_the_ground_is_changed_where_it_should_be() -> None:
    place = generated_place(np.random.default_rng(5), 256, 0.5)
    before, street = place.land.albedo, place.lasting > 0.5
    changed = {s: styled_ground(before, place, s, np.random.default_rng(1)) for s in STYLES}
    assert changed["snow patches"].mean() > before.mean() + 0.05
    assert changed["wet soil"].mean() < before.mean() - 0.02
    for style in ("leaf off", "mown"):
        off = np.abs(changed[style] - before).max(-1)
        assert off[street].max() < 1e-3
        assert (off > 0.02).mean() > 0.01
    leafy = [(c[..., 1] - c[..., [0, 2]].max(-1)).mean() for c in (before, changed["leaf off"])]
    assert leafy[1] < leafy[0]


def test_styles_are_drawn_where_they_are_asked_for() -> None:
    rng = np.random.default_rng(0)
    assert all(draw_visit(rng).style is None for _ in range(50))
    drawn = [draw_visit(rng, 0.5) for _ in range(200)]
    assert {v.style for v in drawn} == {*STYLES, None}
    assert {v.weather for v in drawn if v.style == LAMPS} == {"night"}
    assert visit_of(rng, "mown").style == "mown"


@pytest.mark.parametrize("name", ["train_tiny", "train_s0"])  # pairs on disk, and live ones
def test_a_run_says_how_many_of_its_days_have_a_style(name: str) -> None:
    data = load_config(Path(__file__).parents[3] / "configs" / f"{name}.yaml").data
    assert scene_config(data).styles == 0.0
    assert scene_config(data.model_copy(update={"styles": 0.3})).styles == 0.3
