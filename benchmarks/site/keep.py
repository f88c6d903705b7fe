"""Keep a result for the documentation: its figures, its command, the commit and the machine.

    python -m benchmarks.site.keep report/report.json NAME --title "seed 0, embedded" \\
        --command 'make demo ARGS="--seed 0"' [--machine "2 cores, nothing else running"]

Takes the JSON of a demo flight, of `companion eval` and of `sitl loop-table --out`; then
`python -m benchmarks.site` writes the tables.
"""

from __future__ import annotations

import datetime
import json
from pathlib import Path

from benchmarks.common.arguments import Parser, existing
from benchmarks.common.named_errors import named_errors
from benchmarks.site.kept import DATA, Kept, save, tables_of
from companion.errors import ReportError
from companion.versions import processor

_ROOT = Path(__file__).parents[2]


def made_by(report: Path) -> dict[str, str]:
    """What the report itself says of commit and processor."""
    try:
        versions = json.loads(report.read_text(encoding="utf-8")).get("versions", {})
    except (OSError, ValueError, AttributeError):
        return {}
    return versions if isinstance(versions, dict) else {}


def main() -> None:
    """Keep one."""
    parser = Parser(__doc__)
    parser.add_argument("report", type=existing, help="report.json or a loop table's JSON")
    parser.add_argument("name", help="of the kept file")
    parser.add_argument("--title", default="", help="of its row")
    parser.add_argument("--command", required=True, help="that made it")
    parser.add_argument("--commit", help="of the code that ran; else as the report says")
    parser.add_argument("--machine", help="and what else ran on it; else as the report says")
    options = parser.parse_args()
    table, criteria = tables_of(options.report, options.title or options.name)
    versions = made_by(options.report)
    commit = options.commit or versions.get("commit")
    if commit is None:
        raise ReportError(f"{options.report}: does not say of which commit it is; give --commit")
    made = datetime.date.fromtimestamp(options.report.stat().st_mtime)
    kept = Kept(
        options.command, commit, made.isoformat(),
        options.machine or versions.get("processor") or processor(), options.report.name,
        table, criteria,
    )  # fmt: skip
    path = _ROOT / DATA / f"{options.name}.json"
    path.parent.mkdir(exist_ok=True)
    save(kept, path)
    print(path)


if __name__ == "__main__":
    with named_errors():
        main()
