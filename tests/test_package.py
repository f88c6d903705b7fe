"""What operators install: the wheel in an environment of its own, and the service's unit."""

import configparser
import email
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
UNIT = ROOT / "configs" / "companion.service"
# Packages come from here; what is installed editable does not, so only the wheel has ours.
SITE = next(p for p in map(Path, sys.path) if p.name == "site-packages")


def _run(*command, **options):
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Source distribution, and the wheel that is built from it. From a copy of the source, into
    which setuptools writes.
    """
    folder = tmp_path_factory.mktemp("package")
    source = folder / "source"
    names = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True
    ).stdout.split(b"\0")
    for name in filter(None, map(bytes.decode, names)):
        if (ROOT / name).is_file() and not name.startswith(("tests/", "docs/")):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, source / name)
    backend = "import setuptools.build_meta as b; b.build_{}({!r})"
    _run(sys.executable, "-c", backend.format("sdist", str(folder)), cwd=source)
    (archive,) = folder.glob("*.tar.gz")
    (folder / "unpacked").mkdir()  # Python 3.11.2 unpacks nothing with a filter, 3.14 only so
    _run("tar", "-xzf", str(archive), "-C", str(folder / "unpacked"), cwd=folder)
    (unpacked,) = (folder / "unpacked").iterdir()
    _run(sys.executable, "-c", backend.format("wheel", str(folder)), cwd=unpacked)
    return folder


@pytest.fixture(scope="module")
def environment(built):
    """An environment with nothing of ours but the wheel; what we depend on is borrowed."""
    folder = built / "venv"
    _run(sys.executable, "-m", "venv", "--without-pip", folder)
    site = next(folder.glob("lib/python*/site-packages"))
    (wheel,) = built.glob("*.whl")
    _run(
        sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-compile",
        "--target", site, wheel,
    )  # fmt: skip
    (site / "borrowed.pth").write_text(f"{SITE}\n")
    return folder / "bin" / "python"


def test_the_wheel_has_what_the_program_reads(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    for package in ("localizer", "companion", "mavlink_bridge", "sitl"):
        of_source = {
            str(path.relative_to(ROOT))
            for path in (ROOT / package).rglob("*")
            if path.is_file() and "__pycache__" not in path.parts
        }
        assert of_source <= names, f"not in the wheel: {sorted(of_source - names)[:5]}"
    assert list(built.glob("*.tar.gz"))


def test_the_command_runs_outside_the_checkout(environment, tmp_path):
    program = [environment, "-I"]  # no PYTHONPATH: it may lead to the checkout
    where = _run(*program, "-c", "import companion; print(companion.__file__)", cwd=tmp_path)
    assert str(environment.parents[1]) in where
    assert _run(*program, "-m", "companion", "--version", cwd=tmp_path).startswith("companion 0")


@pytest.mark.long  # compiles every kernel anew: minutes
def test_it_computes_outside_the_checkout(environment, small_assets, small_sequence, tmp_path):
    deployment = str(ROOT / "configs" / "deployment.yaml")
    done = subprocess.run(
        [environment, "-m", "companion", "doctor", "--no-vehicle", deployment],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stdout + done.stderr  # it says that there is no map
    assert "area" in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    said = _run(environment, "-m", "companion", "self-test", cwd=tmp_path)
    assert "self-test passed" in said
    words = ("eval", small_sequence, "--map", small_assets.map_cache, "--limit", "5")
    _run(environment, "-m", "companion", *words, "--report", tmp_path / "report", cwd=tmp_path)
    report = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    assert report["recall_1"] == 100.0


def test_the_units_restrictions_leave_what_the_program_needs():
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(UNIT)
    service = unit["Service"]
    assert service["ProtectSystem"] == "strict"
    assert service["NoNewPrivileges"] == "yes"
    assert "MemoryDenyWriteExecute" not in service  # numba compiles
    assert service["RestrictRealtime"] == "yes"
    assert {"AF_INET", "AF_INET6", "AF_UNIX"} <= set(service["RestrictAddressFamilies"].split())


def test_versions_and_labels_agree():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    version = project.split('\nversion = "', 1)[1].split('"', 1)[0]
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    container = (ROOT / "configs" / "package" / "Containerfile").read_text(encoding="utf-8")
    label = container.split("\nLABEL ", 1)[1].split("\nENTRYPOINT", 1)[0]
    words = dict(word.split("=", 1) for word in shlex.split(label.replace("\\\n", " ")))
    assert words["version"] == version
    for name in ("permissions", "authors", "company", "tags"):
        json.loads(words[name])
    assert "links" not in words  # the project has no public home: who publishes an image adds his


def _pins(lock, python, machine):
    """What a lock pins for a Python and a processor: versions by name."""
    where = {
        "python_version": python, "python_full_version": f"{python}.9", "sys_platform": "linux",
        "platform_machine": machine, "platform_system": "Linux", "os_name": "posix", "extra": "",
    }  # fmt: skip
    pins: dict[str, set[str]] = {}
    for line in (ROOT / lock).read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        pin = Requirement(line)  # a name, a version, a marker: no address, no hash
        assert pin.url is None
        (version,) = pin.specifier
        assert version.operator == "=="
        if pin.marker is None or pin.marker.evaluate(where):
            pins.setdefault(canonicalize_name(pin.name), set()).add(version.version)
    assert all(len(versions) == 1 for versions in pins.values())
    return {name: next(iter(versions)) for name, versions in pins.items()}, where


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12", "3.13"])
def test_the_locks_pin_what_the_project_needs(built, python, machine):
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        (name,) = (n for n in packed.namelist() if n.endswith(".dist-info/METADATA"))
        said = email.message_from_bytes(packed.read(name))
    locks = {
        lock: _pins(lock, python, machine) for lock in ("constraints.txt", "constraints-gpu.txt")
    }
    for line in said.get_all("Requires-Dist", []):
        need = Requirement(line)
        extra = re.search(r'extra == "(\w+)"', line)
        for lock, (pins, where) in locks.items():
            if extra and extra[1] == ("train" if "gpu" in lock else "gpu"):
                continue  # torch asks for CUDA 13, a Jetson has CUDA 12
            here = where | {"extra": extra[1] if extra else ""}
            if need.marker is None or need.marker.evaluate(here):
                assert need.specifier.contains(pins[canonicalize_name(need.name)]), lock


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze")
def test_the_unit_is_hardened():
    said = _run("systemd-analyze", "security", "--offline=true", "--threshold=30", str(UNIT))
    assert "Overall exposure level" in said


_AS_SERVICE = ROOT / "configs" / "package" / "as_service.py"
_TRIES = """
import os, pathlib, socket
def tried(what, *given):
    try:
        what(*given)
    except OSError as error:
        return error.strerror
    return "done"
status = pathlib.Path("/proc/self/status").read_text()
print(tried(pathlib.Path("/usr/mine").touch))
print(tried(pathlib.Path("mine").touch))
print(tried(socket.socket, socket.AF_PACKET, socket.SOCK_RAW))
print(tried(socket.socket, socket.AF_INET, socket.SOCK_DGRAM))
print(tried(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(1)))
print(os.listdir("/root"), "CapBnd:\\t0000000000000000" in status, "NoNewPrivs:\\t1" in status)
"""


def _cannot_be_restricted():
    if os.geteuid() != 0 or shutil.which("systemd-analyze") is None:
        return "needs root and systemd-analyze"
    for command in (["/usr/bin/python3", "-c", "import seccomp"], ["unshare", "--mount", "true"]):
        if subprocess.run(command, check=False, capture_output=True).returncode != 0:
            return f"needs what allows: {' '.join(command)}"
    return ""


@pytest.mark.skipif(bool(_cannot_be_restricted()), reason=_cannot_be_restricted() or "restricted")
def test_a_command_runs_under_the_units_restrictions(tmp_path):
    state = Path("/var/lib/companion")
    if state.exists():  # with it, there is a cache that must stay
        pytest.skip(f"{state} is an installed companion's")
    try:
        done = subprocess.run(
            [_AS_SERVICE, "--user", "65534:65534", "/usr/bin/python3", "-c", _TRIES],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    finally:
        for folder in (state, Path("/var/cache/companion")):
            shutil.rmtree(folder, ignore_errors=True)
    refused = "Operation not permitted"
    assert done.stdout.splitlines() == [
        "Read-only file system", "done", refused, "done", refused, "[] True True",
    ], done.stderr  # fmt: skip
    assert "not applied ProtectProc" in done.stderr
