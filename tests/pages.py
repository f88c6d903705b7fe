"""The documentation's pages: the repository's files, and those that are written with the site."""

from pathlib import Path

from benchmarks.site.pages import built_pages

ROOT = Path(__file__).parents[1]
_FILES = [
    *ROOT.glob("docs/**/*.md"),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
]
PAGES = {path: path.read_text(encoding="utf-8") for path in sorted(_FILES)} | {
    ROOT / "docs" / name: text for name, text in built_pages().items()
}
