"""The kernels as machine code: they compile for every supported chip, and use what they should."""

from __future__ import annotations

import re
from dataclasses import dataclass

import pytest

from localizer.registration.cuda import compiler
from localizer.registration.cuda.compiler import compile_kernels
from localizer.registration.cuda.errors import CudaError, CudaUnavailableError
from localizer.registration.cuda.layout import macros
from localizer.registration.cuda.steps import KERNELS

HOT = ("refine_many", "refine_few")
MOST_REGISTERS = 128  # two blocks of 256 threads fill the 65536 registers of a multiprocessor
MOST_SHARED = 48 * 1024  # static, on every architecture


@dataclass(frozen=True)
class Resources:
    registers: int
    stack: int
    spilled: int
    shared: int


def resources(log: str) -> dict[str, Resources]:
    """Per kernel, what the assembler reports."""
    found = {}
    for part in log.split("Compiling entry function '")[1:]:
        name = part.split("'")[0]
        stack, stores, loads = map(int, re.search(
            r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", part
        ).groups())  # fmt: skip
        (registers,) = map(int, re.findall(r"Used (\d+) registers", part)[:1])
        shared = re.search(r"(\d+) bytes smem", part)
        found[name] = Resources(registers, stack, stores + loads, int(shared[1]) if shared else 0)
    return found


@pytest.fixture(scope="module")
def _compiler():
    try:
        compiler.load_nvrtc()
    except CudaUnavailableError as error:
        pytest.skip(str(error))


# Six seconds each, which is what the assembler takes.
@pytest.mark.parametrize("architecture", [(8, 7), (8, 9), (9, 0)])
@pytest.mark.usefixtures("_compiler")
def test_machine_code_and_its_resources(tmp_path, architecture):
    image = compile_kernels(32, architecture, tmp_path)
    assert image.code[:4] == b"\x7fELF"
    found = resources(image.log)
    assert set(found) == set(KERNELS)
    for name, used in found.items():
        assert used.registers <= MOST_REGISTERS
        assert used.shared <= MOST_SHARED
        # The winner's kernels run once a frame; the hot ones must not touch local memory.
        assert used.spilled <= (0 if name in HOT else 64), name
        assert used.stack <= (0 if name in HOT else 64), name


@pytest.mark.usefixtures("_compiler")
def test_the_cache_is_used_and_told_apart(tmp_path, monkeypatch):
    first = compile_kernels(4, (8, 7), tmp_path)
    assert [path.suffix for path in tmp_path.iterdir()] == [".cubin"]

    def refuse(*_):
        raise AssertionError("compiled again")

    monkeypatch.setattr(compiler, "compile_image", refuse)
    assert compile_kernels(4, (8, 7), tmp_path).code == first.code
    for other in ((8, (8, 7)), (4, (8, 9))):
        with pytest.raises(AssertionError, match="compiled again"):
            compile_kernels(*other, tmp_path)
    monkeypatch.setattr(compiler, "macros", lambda *_: {"CHANNELS": 4, "IN_FLIGHT": 1})
    with pytest.raises(AssertionError, match="compiled again"):
        compile_kernels(4, (8, 7), tmp_path)


@pytest.mark.usefixtures("_compiler")
def test_a_disk_that_refuses_costs_only_time(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert compile_kernels(4, (8, 7), blocked / "cache").code[:4] == b"\x7fELF"


@pytest.mark.usefixtures("_compiler")
def test_layouts_that_differ_do_not_compile(tmp_path, monkeypatch):
    wrong = macros(4) | {"BYTES_OF_State": 8}
    monkeypatch.setattr(compiler, "macros", lambda *_: wrong)
    with pytest.raises(CudaError, match=r"layout\.py differs: State"):
        compile_kernels(4, (8, 7), tmp_path)


@pytest.mark.usefixtures("_compiler")
def test_an_unknown_architecture_is_an_error(tmp_path):
    with pytest.raises(CudaError, match="sm_11"):
        compile_kernels(4, (1, 1), tmp_path)
