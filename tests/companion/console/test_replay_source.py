"""A record in the page: rows at their times, and the time bar."""

import asyncio
import json
import struct

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.cli.replay import show_record
from companion.console.pictures import page_message
from companion.console.replay_source import ReplaySource
from companion.errors import ConfigError
from companion.flight.recorder import ESTIMATE_COLUMNS, EVENT_COLUMNS, TARGET_COLUMNS
from companion.offline.record import read_record
from companion.reporting.pictures import map_pictures
from localizer.map.cache.cache import TileCache
from mavlink_bridge.link.tlog import TlogRecorder
from tests.companion.console.record_of import write_record, write_rows

S = 1_000_000_000
TIMES = {"tracks_s": 11, "event_s": 15, "picture_s": 14}


@pytest.fixture
def source(tmp_path):
    return ReplaySource(read_record(write_record(tmp_path / "flight", **TIMES)))


def _at(source, share):
    assert asyncio.run(source.order({"share": share})) == (True, "done")
    return source.newest.state


def test_the_time_bar_leads_to_what_was_known_then(source):
    state = _at(source, 0.1)
    assert (state["estimate"]["time_ns"], state["estimate"]["latitude_deg"]) == (12 * S, 47.0)
    assert [t["name"] for t in state["targets"]] == ["car"]
    assert (state["health"]["level"], state["events"], source.newest.frame) == ("ok", [], None)
    assert state["utc_ns"] == 1002 * S
    state = _at(source, 0.75)
    assert (state["estimate"]["state"], state["health"]["level"]) == ("lost", "failed")
    assert [e["text"].partition(": ")[2] for e in state["events"]] == ["localization lost 9 s"]
    assert state["targets"] == []  # seen 13 s ago
    assert source.newest.frame.head["image"] == [480, 360]


def test_figures_of_the_head_are_those_of_that_moment(source):
    state = _at(source, 0.75)
    assert state["health"]["rate_hz"] == pytest.approx(1.0)  # a row a second
    assert state["estimate"]["last_fix_ns"] == 20 * S  # the last that was accepted
    assert [round(s["t"]) for s in source.newest.samples] == list(range(1000, 1016))
    assert len({e["number"] for e in source.newest.events}) == 1


def test_a_kept_picture_is_no_live_one_and_says_where_its_targets_were(source):
    state = _at(source, 0.2)
    assert state["targets"][0]["pixel"] == [0.0, 0.0]
    _at(source, 0.5)
    message = page_message(source.newest.frame, False)
    (size,) = struct.unpack_from("<I", message)
    head = json.loads(message[4 : 4 + size])
    assert (head["exposure_ns"], head["exposure_utc_ms"]) == (14 * S, None)


def test_with_the_map_the_picture_has_its_edges_and_the_autopilot_its_track(small_assets, tmp_path):
    """The camera stands 80 m above the map's origin and looks down."""
    tlog = tmp_path / "flight.tlog"
    bridge = {"tlog": str(tlog)}
    record = write_record(tmp_path / "flight", small_assets.map_cache, **TIMES, bridge=bridge)
    at, codec = TileCache.open(small_assets.map_cache).frame.origin, mavlink.MAVLink(None, 1, 1)
    place = (round(at.latitude_deg * 1e7), round(at.longitude_deg * 1e7), 0)
    log = TlogRecorder(tlog)
    log.start()
    position = mavlink.MAVLink_global_position_int_message(1, *place, 0, 0, 0, 0, 0)
    log.write(position.pack(codec), 1004_000_000)
    log.close()
    with map_pictures(small_assets.map_cache) as pictures:
        source = ReplaySource(read_record(record), pictures)
        state = _at(source, 0.25)
        assert state["vehicle"]["latitude_deg"] == pytest.approx(at.latitude_deg, abs=1e-6)
        message = page_message(source.newest.frame, True)
    (size,) = struct.unpack_from("<I", message)
    head = json.loads(message[4 : 4 + size])
    assert len(head["footprint_enu_m"]) == 4
    assert head["parts"][2] > 0  # the map as it was seen from there


@pytest.mark.parametrize("order", [{}, {"share": 2}, {"share": "x"}, {"play": 1}, {"share": None}])
def test_an_order_that_makes_no_sense_is_refused(source, order):
    assert asyncio.run(source.order(order))[0] is False


def test_the_heading_is_where_the_top_of_the_picture_points(source):
    """qx = 1: the camera looks straight down, its picture's top to the north."""
    assert _at(source, 0.0)["estimate"]["heading_deg"] == pytest.approx(0.0)


@pytest.mark.parametrize("value", ["nan", "", "inf", "-1e308"])
def test_what_no_browser_reads_is_not_sent(tmp_path, value):
    numbers = ("qw", "qx", "sigma_east_m", "latitude_deg", "quality", "hpl_m", "latency_ms")
    row = {"exposure_time_ns": S, "state": "tracking"} | dict.fromkeys(numbers, value)
    write_rows(tmp_path / "estimates.csv", ESTIMATE_COLUMNS, [row])
    spoilt = ("latitude_deg", "sigma_up_m", "cov_en") if value != "-1e308" else ()
    target = {"exposure_time_ns": S, "target_id": "car"} | dict.fromkeys(spoilt, value)
    write_rows(tmp_path / "targets.csv", TARGET_COLUMNS, [target])
    write_rows(tmp_path / "events.csv", EVENT_COLUMNS, [])
    (tmp_path / "record.json").write_text(json.dumps({"utc_ns": "x", "monotonic_ns": None}))
    source = ReplaySource(read_record(tmp_path))
    asyncio.run(source.order({"share": 0.0}))
    assert source.newest.states == 1
    json.dumps([source.newest.state, *source.newest.samples], allow_nan=False)


def test_an_address_that_is_none_is_one_line(tmp_path):
    write_rows(tmp_path / "estimates.csv", ESTIMATE_COLUMNS, [])
    for name, columns in (("targets.csv", TARGET_COLUMNS), ("events.csv", EVENT_COLUMNS)):
        write_rows(tmp_path / name, columns, [])
    for listen in ("nonsense", "127.0.0.1:99999"):
        with pytest.raises(ConfigError, match="--console") as told:
            show_record(tmp_path, tmp_path, listen)
        assert "\n" not in str(told.value)
