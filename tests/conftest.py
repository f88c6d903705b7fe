"""Fixtures for every test: a world, the real data sets and the autopilot, or a printed skip."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import hypothesis
import pytest

os.environ["NUMBA_NRT_STATS"] = "1"  # before numba is imported: a test counts allocations

from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.synth.world import build_visits
from sitl.demo import assets
from sitl.demo.assets import FlightAssets
from sitl.demo.kinematic import record_scenario
from sitl.demo.scenario import CameraSpec, Scenario, ScenarioLeg
from sitl.errors import SimulationError
from sitl.vehicles.launch import find_arducopter
from tests.localizer.map.conftest import write_tileset
from tests.parts import PARTS, SHARED_FOLDER, part_of

# The suite tries the same examples every time, so that a failure belongs to the change it is seen
# on; `pytest --hypothesis-profile=explore` draws new ones. No deadlines: a busy machine takes its
# time over an example or its drawing, and what is slow shows in the suite's durations.
_PATIENT = {"deadline": None, "suppress_health_check": [hypothesis.HealthCheck.too_slow]}
hypothesis.settings.register_profile("repeatable", derandomize=True, max_examples=40, **_PATIENT)
hypothesis.settings.register_profile("explore", **_PATIENT)
hypothesis.settings.load_profile("repeatable")

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def _signal_handlers_are_left_alone() -> Iterator[None]:
    """A handler that a test leaves behind is another test's riddle."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    assert [signal.getsignal(number) for number in numbers] == before


@pytest.fixture(scope="session")
def real_data() -> Callable[[str], Path]:
    """``real_data("quito")``: a real data set's folder, or a skip that names where it is not."""
    base = Path(os.environ.get("PILOT_DATA", ROOT.parent / "shared" / "data"))

    def folder(name: str) -> Path:
        if not (base / name).is_dir():
            pytest.skip(f"real data set {name!r} is not in {base} (set PILOT_DATA)")
        return base / name

    return folder


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What tests of every process and part share: who writes to it holds `_alone_at`."""
    given = os.environ.get(SHARED_FOLDER)
    return Path(given) if given else tmp_path_factory.mktemp("shared")


@contextmanager
def _alone_at(path: Path) -> Iterator[None]:
    """Other processes that ask for the same wait."""
    with path.with_name(f"{path.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="session")
def small_assets(shared_folder: Path) -> FlightAssets:
    """A 400 m world with both caches, so all tests share it.

    Made in this process: more than half of the time was that of others that started.
    """
    worlds = shared_folder / "worlds"
    with _alone_at(worlds), pytest.MonkeyPatch.context() as patch:
        patch.setattr(assets, "build_visits", partial(build_visits, processes=1))
        patch.setattr(assets, "build_cache", partial(build_cache, options=BuildOptions(workers=1)))
        return assets.prepare(5, worlds, size_m=400.0, ideal=True)


@pytest.fixture(scope="session")
def quito_map(real_data: Callable[[str], Path], shared_folder: Path) -> Path:
    """The real mesh "quito" as a tile cache: half a minute of processor, so all tests share it."""
    source, cache = real_data("quito") / "tileset.json", shared_folder / "quito"
    with _alone_at(cache):
        if not cache.exists():
            build_cache(source, cache)
    return cache


@pytest.fixture(scope="session")
def terrain(shared_folder: Path) -> TileCache:
    """The 21 tiles of `write_tileset` as a tile cache: nobody changes it, so all tests share it."""
    folder = shared_folder / "terrain"
    with _alone_at(folder):
        if not (folder / "cache").exists():
            build_cache(write_tileset(folder), folder / "cache", BuildOptions(workers=1))
    return TileCache.open(folder / "cache")


@pytest.fixture(scope="session")
def small_sequence(small_assets: FlightAssets, shared_folder: Path) -> Path:
    """A video of the small world at 5 Hz with its true poses, as `companion eval` reads it."""
    leg = ScenarioLeg(east_m=0, north_m=26, height_m=80, gimbal_pitch_deg=-85)
    scenario = Scenario(
        takeoff_height_m=80, legs=(leg,), cars=2, people=2, camera=CameraSpec(rate_hz=5)
    ).ideal()
    out, done = shared_folder / "sequence", shared_folder / "sequence-complete"
    with _alone_at(out):
        if not done.exists():
            shutil.rmtree(out, ignore_errors=True)
            assert record_scenario(small_assets, scenario, 5, out) >= 25
            done.touch()
    return out


@pytest.fixture
def real_time() -> Callable[[], AbstractContextManager[None]]:
    """``with real_time():`` around what needs two processors while it runs.

    A starved companion lands its vehicle, as it should, and a starved receiver is late: that says
    nothing of the code. So it skips, with what was measured, where other work leaves no time before
    it, or none during or after it where it failed; a failure on a machine with room is a failure.
    """

    @contextmanager
    def guarded() -> Iterator[None]:
        _skip_if_starved("before the test")
        with _watched_processors() as processors:
            try:
                yield
            except (AssertionError, SimulationError) as error:
                if processors.shared:
                    pytest.skip(f"{processors} while it failed ({error})")
                _skip_if_starved(f"after it failed ({error})")
                raise

    return guarded


@pytest.fixture
def watched_processors() -> Callable[[], AbstractContextManager[Processors]]:
    """``with watched_processors() as processors:`` tells whether they were `shared` meanwhile."""
    return _watched_processors


@dataclass(frozen=True)
class Reading:
    """Seconds since some start: of the wall's clock, of processors that idled, of processors that
    worked, and of those that worked for this process and its children. What runs at a lower
    priority gives way, and counts as idle.
    """

    wall_s: float
    idle_s: float
    busy_s: float
    own_s: float


def most_other_work(readings: Sequence[Reading], span_s: float = 5.0) -> float:
    """The largest share of the processors that others took over a span in which none was idle."""
    worst, first = 0.0, 0
    for last in readings:
        while last.wall_s - readings[first].wall_s > span_s:
            first += 1
        since = readings[max(first - 1, 0)]
        idle_s, busy_s = last.idle_s - since.idle_s, last.busy_s - since.busy_s
        if last.wall_s - since.wall_s >= span_s and idle_s < 0.05 * (idle_s + busy_s):
            worst = max(worst, (busy_s - (last.own_s - since.own_s)) / busy_s)
    return worst


@dataclass(frozen=True)
class Processors:
    """What they did for us and for others; `str` says it."""

    readings: list[Reading]

    @property
    def shared(self) -> bool:
        """Whether other work had more than a little of processors that were never idle."""
        return most_other_work(self.readings) > 0.15

    def __str__(self) -> str:
        share = most_other_work(self.readings)
        return f"other work took {100 * share:.0f} % of processors that were not idle for 5 s"


@contextmanager
def _watched_processors() -> Iterator[Processors]:
    readings, ended = [read_processors()], threading.Event()

    def watch() -> None:
        while not ended.wait(1.0):
            readings.append(read_processors())

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield Processors(readings)
    finally:
        ended.set()
        watcher.join()


def read_processors() -> Reading:
    """Of Linux's /proc; what a hypervisor took away counts as work of others."""
    tick_s = 1.0 / os.sysconf("SC_CLK_TCK")
    user, nice, system, idle, waiting, *rest = (
        int(ticks) * tick_s for ticks in Path("/proc/stat").read_text().split("\n")[0].split()[1:9]
    )
    own_s, parents, used_s = 0.0, {os.getpid()}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended
            fields = stat.read_text().rpartition(")")[2].split()
            used_s[int(stat.parent.name)] = int(fields[1]), sum(map(int, fields[11:15])) * tick_s
    while parents:
        own_s += sum(used_s[pid][1] for pid in parents)
        parents = {pid for pid, (parent, _) in used_s.items() if parent in parents}
    busy_s = user + system + sum(rest)
    return Reading(time.monotonic(), idle + waiting + nice, busy_s, own_s)


def _skip_if_starved(when: str) -> None:
    share = _processor_share(workers=2)
    if share < 0.65:
        pytest.skip(
            f"two processes got {100 * share:.0f} % of two cores {when}: other work (load average "
            f"{os.getloadavg()[0]:.0f}) leaves no time for what runs in real time"
        )


def _processor_share(workers: int, seconds: float = 1.5) -> float:
    """What busy processes get of as many cores: 1 on an idle machine."""
    spin = (
        f"import time; end = time.monotonic() + {seconds}; begin = time.process_time()\n"
        "while time.monotonic() < end: pass\n"
        "print(time.process_time() - begin)"
    )
    started = [
        subprocess.Popen([sys.executable, "-c", spin], stdout=subprocess.PIPE, text=True)
        for _ in range(workers)
    ]
    return sum(float(p.communicate()[0]) for p in started) / (workers * seconds)


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--part`: one of the suite's parts (tests/parts.py); all without it."""
    parser.addoption("--part", choices=PARTS, help="one part of the suite")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """A file of another part is not even imported, unless it is named on the command line."""
    named = [Path(argument.split("::")[0]).resolve() for argument in config.args]
    other = collection_path.suffix == ".py" and not _wanted(collection_path, config)
    return True if other and collection_path not in named else None


def _wanted(path: Path, config: pytest.Config) -> bool:
    return config.getoption("--part") in (None, part_of(path.relative_to(ROOT).as_posix()))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the part asked for; skip what needs a missing part, with the reason.

    Files with tests of real data, which take longest, come first: no worker ends with one of them
    while the other has nothing left to do.
    """
    long = {item.path for item in items if item.get_closest_marker("real")}
    items.sort(key=lambda item: item.path not in long)
    others = [item for item in items if not _wanted(item.path, config)]
    config.hook.pytest_deselected(items=others)
    items[:] = [item for item in items if item not in set(others)]
    if find_arducopter() is None:
        reason = pytest.mark.skip(reason="no arducopter on PATH or in ARDUPILOT_HOME")
        for item in items:
            if item.get_closest_marker("sitl"):
                item.add_marker(reason)
