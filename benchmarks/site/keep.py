"""Keep a result for the documentation: its figures, its command, the commit and the machine.

    python -m benchmarks.site.keep report/report.json NAME --title "seed 0, embedded" \\
        --command 'make demo ARGS="--seed 0"' [--machine "2 cores, nothing else running"]

Takes the JSON of a demo flight, of `companion eval` and of `sitl loop-table --out`; then
`python -m benchmarks.site` writes the tables.
"""

from __future__ import annotations

import datetime
import os
import re
import subprocess
from pathlib import Path

from benchmarks.common.arguments import Parser, existing
from benchmarks.common.named_errors import named_errors
from benchmarks.site.kept import DATA, Kept, save, tables_of
from companion.errors import ReportError

_ROOT = Path(__file__).parents[2]


def commit() -> str:
    """Of this checkout, with `+` where it holds what is not committed."""
    git = ["git", "-C", str(_ROOT)]
    done = subprocess.run(
        [*git, "describe", "--always", "--abbrev=8", "--dirty=+"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise ReportError(f"{_ROOT}: no git checkout; say --commit")
    return done.stdout.strip()


def machine() -> str:
    """Processor, cores, and how many processes wanted them."""
    found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.M)
    name = found.group(1).strip() if found else os.uname().machine
    return f"{os.cpu_count()} cores of {name}, load {os.getloadavg()[2]:.0f}"


def main() -> None:
    """Keep one."""
    parser = Parser(__doc__)
    parser.add_argument("report", type=existing, help="report.json or a loop table's JSON")
    parser.add_argument("name", help="of the kept file")
    parser.add_argument("--title", default="", help="of its row")
    parser.add_argument("--command", required=True, help="that made it")
    parser.add_argument("--commit", help="of the code that ran; else this checkout's")
    parser.add_argument("--machine", help="and what else ran on it; else this one's")
    options = parser.parse_args()
    table, criteria = tables_of(options.report, options.title or options.name)
    made = datetime.date.fromtimestamp(options.report.stat().st_mtime)
    kept = Kept(
        options.command, options.commit or commit(), made.isoformat(),
        options.machine or machine(), options.report.name, table, criteria,
    )  # fmt: skip
    path = _ROOT / DATA / f"{options.name}.json"
    path.parent.mkdir(exist_ok=True)
    save(kept, path)
    print(path)


if __name__ == "__main__":
    with named_errors():
        main()
