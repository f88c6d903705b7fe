"""The documentation's generated parts, written anew.

    python -m benchmarks.site            # the alerts' page, the results' tables
    python -m benchmarks.site --check    # ends with 1 and names what is not of today
    python -m benchmarks.site --figures  # of the results pages
    python -m benchmarks.site --pictures report    # the README's, of `make demo`'s report folder

The site itself: `mkdocs build --strict` (extra `docs`), then site/index.html.
"""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.common.arguments import Parser, existing
from benchmarks.common.named_errors import named_errors
from benchmarks.site.alerts import alerts_page
from benchmarks.site.figures import draw_all
from benchmarks.site.kept import DATA, with_tables
from benchmarks.site.pictures import keep

_ROOT = Path(__file__).parents[2]


def pages() -> dict[Path, str]:
    """Path from the repository's root to the text that must stand there."""
    results = {
        path.relative_to(_ROOT): with_tables(path.read_text(encoding="utf-8"), _ROOT / DATA)
        for path in (_ROOT / "docs").rglob("*.md")
    }
    return results | {Path("docs/reference/alerts.md"): alerts_page()}


def outdated(root: Path) -> list[Path]:
    """The generated pages that do not stand there as they would be written today."""
    return [
        path
        for path, text in pages().items()
        if not (root / path).is_file() or (root / path).read_text(encoding="utf-8") != text
    ]


def main() -> None:
    """Write them, or name those that are not of today."""
    parser = Parser(__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--pictures", type=existing, metavar="REPORT", help="of a demo flight")
    parser.add_argument("--figures", action="store_true", help="draw those of the results")
    options = parser.parse_args()
    if options.figures:
        print(*draw_all(_ROOT), sep="\n")
        return
    if options.pictures is not None:
        print(*keep(options.pictures, _ROOT / "docs" / "img"), sep="\n")
        return
    names = outdated(_ROOT)
    for name in names:
        if options.check:
            print(f"{name}: not of today; run python -m benchmarks.site", file=sys.stderr)
        else:
            (_ROOT / name).write_text(pages()[name], encoding="utf-8")
            print(name)
    sys.exit(1 if options.check and names else 0)


if __name__ == "__main__":
    with named_errors():
        main()
