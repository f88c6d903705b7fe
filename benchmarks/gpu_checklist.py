"""Everything that waits for a GPU, in one command and at most ten minutes, into one folder.

    python -m benchmarks.gpu_checklist [--sequence SEQ --map CACHE] [--out gpu-report]

Steps: what the machine is; the tests marked gpu; the same under compute-sanitizer (memcheck, then
racecheck), where it is installed; the renderers' tests and times; the time of both networks on
every execution provider; the optimizer benchmark's GPU part; `companion eval` of a recorded
sequence on the GPU and on the CPU. A step that fails or runs out of time is reported and the next
one runs. The folder: `report.md`, and the JSON of each table for `benchmarks.site.keep`. The exit
code is 1 if a step failed, 2 if there is no GPU.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.arguments import Parser, existing, number, output
from benchmarks.common.figures import markdown, write_figures
from benchmarks.common.named_errors import named_errors
from localizer.registration.cuda.driver import Device
from localizer.registration.cuda.errors import CudaError

ROOT = Path(__file__).resolve().parent.parent
TESTS = "tests/localizer/registration/cuda"
COLUMNS = ("step", "result", "s", "last line")
_TAIL = 60  # lines of a step's output that are kept
_LAST_S = 5.0  # with less time than this left nothing is started


@dataclass(frozen=True)
class ChecklistStep:
    """A command and the seconds it may take."""

    title: str
    command: tuple[str, ...]
    limit_s: float


@dataclass(frozen=True)
class StepOutcome:
    """What became of a step: ok, failed, out of time, or skipped with the reason."""

    step: ChecklistStep
    verdict: str
    seconds: float
    output: str


def steps(sequence: Path | None, cache: Path | None, out: Path) -> list[ChecklistStep]:
    python = sys.executable
    tests = (python, "-m", "pytest", "-q", "-rs", "-m", "gpu", TESTS)
    found = [
        ChecklistStep("machine", ("nvidia-smi", "-L"), 20),
        ChecklistStep("tests marked gpu", tests, 150),
    ]
    for tool in ("memcheck", "racecheck"):
        sanitizer = ("compute-sanitizer", "--tool", tool, "--error-exitcode", "9",
                     "--target-processes", "all")  # fmt: skip
        command = (*sanitizer, *tests, "-k", "agrees_with_the_reference or agrees_with_the_cpu")
        found.append(ChecklistStep(f"compute-sanitizer {tool}", command, 90))
    parity = (python, "-m", "pytest", "-q", "-rs", "tests/localizer/render/test_parity.py")
    found.append(ChecklistStep("tests of the renderers", parity, 90))
    for title, module, limit_s in (
        ("rendering", "rendering --triangles 1", 90),
        ("networks", "features.network_speed", 120),
        ("optimizer", "optimizer.gpu", 150),
    ):
        words = (*f"benchmarks.{module}".split(), "--json", f"{out}/{title}.json")
        found.append(ChecklistStep(title, (python, "-m", *words), limit_s))
    if sequence is not None and cache is not None:
        evaluation = (python, "-m", "companion", "eval", str(sequence), "--map", str(cache),
                      "--limit", "100")  # fmt: skip
        on_gpu = (*evaluation, "--device", "cuda", "--report", f"{out}/eval-gpu")
        on_cpu = ("env", "CUDA_VISIBLE_DEVICES=", *evaluation, "--device", "cpu",
                  "--renderer", "numba", "--report", f"{out}/eval-cpu")  # fmt: skip
        found.append(ChecklistStep("companion eval on the GPU", on_gpu, 90))
        found.append(ChecklistStep("companion eval on the CPU", on_cpu, 90))
    return found


def run(step: ChecklistStep, limit_s: float) -> StepOutcome:
    """Run one step within a limit."""
    if shutil.which(step.command[0]) is None:
        return StepOutcome(step, f"skipped: no {step.command[0]} here", 0.0, "")
    if limit_s < _LAST_S:
        return StepOutcome(step, "skipped: no time left", 0.0, "")
    started = time.monotonic()
    try:
        done = subprocess.run(
            step.command, cwd=ROOT, capture_output=True, text=True, timeout=limit_s, check=False
        )
        verdict = "ok" if done.returncode == 0 else f"failed ({done.returncode})"
        output = done.stdout + done.stderr
    except subprocess.TimeoutExpired as error:
        verdict = f"out of time ({limit_s:.0f} s)"
        output = error.stdout.decode(errors="replace") if isinstance(error.stdout, bytes) else ""
    return StepOutcome(step, verdict, time.monotonic() - started, output)


def text_of(outcomes: list[StepOutcome]) -> str:
    """The report, as Markdown."""
    lines = ["# GPU checklist", "", markdown(COLUMNS, rows_of(outcomes))]
    for o in outcomes:
        tail = "\n".join(o.output.splitlines()[-_TAIL:])
        lines += ["", f"## {o.step.title}", "", f"`{' '.join(o.step.command)}`", "", "```", tail,
                  "```"]  # fmt: skip
    return "\n".join(lines) + "\n"


def rows_of(outcomes: list[StepOutcome]) -> list[tuple[str, ...]]:
    """A row of `COLUMNS` for each step; the last line where the step writes no table itself."""
    rows = list[tuple[str, ...]]()
    for o in outcomes:
        lines = [line.strip("= ") for line in o.output.splitlines() if line.strip()]
        has_table = {"--json", "--report"} & {*o.step.command}
        last = lines[-1] if lines and not has_table else ""
        rows.append((o.step.title, o.verdict, f"{o.seconds:.0f}", last))
    return rows


def main() -> int:
    parser = Parser(__doc__)
    parser.add_argument("--sequence", type=existing, help="recorded sequence for companion eval")
    parser.add_argument("--map", type=existing, help="its tile cache")
    parser.add_argument(
        "--out", type=output, default=Path("gpu-report"), help="folder of the results"
    )
    parser.add_argument("--minutes", type=number(0.1, 600), default=10.0, help="for everything")
    arguments = parser.parse_args()
    try:
        print(f"GPU: {Device().name}")
    except CudaError as error:
        print(f"nothing to do: {error}")
        return 2
    deadline = time.monotonic() + 60 * arguments.minutes
    outcomes: list[StepOutcome] = []
    out = arguments.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    for step in steps(arguments.sequence, arguments.map, out):
        outcomes.append(run(step, min(step.limit_s, deadline - time.monotonic())))
        print(f"{step.title}: {outcomes[-1].verdict}", flush=True)
        (out / "report.md").write_text(text_of(outcomes))  # after each: a lease may end early
        write_figures(out / "checklist.json", COLUMNS, rows_of(outcomes))
    return int(any(o.verdict.startswith(("failed", "out of")) for o in outcomes))


if __name__ == "__main__":
    with named_errors():
        sys.exit(main())
