"""Keep a result for the documentation: its figures, its command, the commit and the machine.

    python -m benchmarks.site.keep report/report.json NAME --title "seed 0, embedded" \\
        --command 'make demo ARGS="--seed 0"' [--machine "2 cores, nothing else running"]

Takes the JSON of a demo flight, `companion eval`, `sitl suite`, `sitl loop`, `sitl follow` and the
benchmarks; `--also` adds further files of the same form. Then `python -m benchmarks.site` writes
the tables, and `python -m benchmarks.site --figures` the figures.
"""

from __future__ import annotations

import datetime
import json
from pathlib import Path

from benchmarks.common.arguments import Parser, existing
from benchmarks.common.named_errors import named_errors
from benchmarks.site.forms import tables_of
from benchmarks.site.kept import DATA, Kept, save
from companion.errors import ReportError
from companion.versions import processor

_ROOT = Path(__file__).parents[2]


def made_by(report: Path) -> dict[str, str]:
    """What the report itself says of commit and processor."""
    try:
        data = json.loads(report.read_text(encoding="utf-8"))
        versions = data.get("versions") or data["self_test"]["versions"]
    except (OSError, ValueError, AttributeError, KeyError, TypeError):
        return {}
    return versions if isinstance(versions, dict) else {}


def main() -> None:
    """Keep one."""
    parser = Parser(__doc__)
    parser.add_argument("report", type=existing, help="what the command wrote")
    parser.add_argument("name", help="of the kept file")
    parser.add_argument("--also", type=existing, nargs="+", default=[], help="more of that form")
    parser.add_argument("--only", nargs="+", default=[], help="rows of these names")
    parser.add_argument("--title", default="", help="of its row")
    parser.add_argument("--command", required=True, help="that made it")
    parser.add_argument("--commit", help="of the code that ran; else as the report says")
    parser.add_argument("--machine", help="and what else ran on it; else as the report says")
    options = parser.parse_args()
    reports = [options.report, *options.also]
    table, criteria = tables_of(reports, options.title, options.only)
    versions = made_by(options.report)
    commit = options.commit or versions.get("commit")
    if commit is None:
        raise ReportError(f"{options.report}: does not say of which commit it is; give --commit")
    made = datetime.date.fromtimestamp(options.report.stat().st_mtime)
    kept = Kept(
        options.command, commit, made.isoformat(),
        options.machine or versions.get("processor") or processor(),
        ", ".join(dict.fromkeys(report.name for report in reports)), table, criteria,
    )  # fmt: skip
    path = _ROOT / DATA / f"{options.name}.json"
    path.parent.mkdir(exist_ok=True)
    save(kept, path)
    print(path)


if __name__ == "__main__":
    with named_errors():
        main()
