"""mkdocs' hooks: the pages made from the program, and the files beside docs/ that pages link to.

Pages link to sources as they lie in the repository (`../../configs/deployment.yaml`), so that the
links hold wherever the repository is read. The site has only what lies under docs/: each linked
file becomes a page of its own, `source/configs/deployment.yaml.html`, and the links are turned.
"""

from __future__ import annotations

import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

_ROOT = Path(__file__).parents[2]
_LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
_LANGUAGES = {".yaml": "yaml", ".py": "python", ".json": "json", ".sh": "sh", ".service": "ini"}
_SOURCE = "source/"
_THEMES_WORKER = "https://unpkg.com/iframe-worker/shim"


def on_files(files: Files, config: Any) -> Files:
    """Add the pages made from the program, and one for every file outside of docs/ that is linked.

    A file that such a page links to gets a page, too.
    """
    sys.path.insert(0, str(_ROOT))  # the command `mkdocs` finds installed packages only
    from benchmarks.site.pages import built_pages

    for name, text in built_pages().items():
        files.append(File.generated(config, name, content=text))
    waiting = [
        (posixpath.join("docs", file.src_uri), file.content_string)
        for file in files.documentation_pages()
    ]
    known: set[str] = set()
    while waiting:
        path, text = waiting.pop()
        for target in _outside(path, text):
            if target in known or not (_ROOT / target).exists():
                continue
            known.add(target)
            page = _page(target)
            if target.endswith(".md"):
                waiting.append((target, page))
            files.append(
                File.generated(
                    config, _uri(target), content=page, inclusion=InclusionLevel.NOT_IN_NAV
                )
            )
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn the links that leave docs/ towards those pages; what does not exist stays, and fails."""
    uri = page.file.src_uri
    ours = uri.removeprefix(_SOURCE).removesuffix(".md") if uri.startswith(_SOURCE) else None
    path = posixpath.join("docs", uri) if ours is None else ours
    folder = posixpath.dirname(uri)

    def turned(found: re.Match[str]) -> str:
        begin, link, anchor, end = found.groups()
        target = _target(path, link)
        if target is None or not (_ROOT / target).exists():
            return found.group(0)
        inside = target.removeprefix("docs/") if target.startswith("docs/") else _uri(target)
        return f"{begin}{posixpath.relpath(inside, folder or '.')}{anchor or ''}{end}"

    return (
        markdown if ours is not None and not ours.endswith(".md") else _LINK.sub(turned, markdown)
    )


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """The theme would fetch what lets the search run from the file system: ours lies beside it."""
    ours = posixpath.relpath("js/worker.js", posixpath.dirname(page.file.dest_uri) or ".")
    return output.replace(_THEMES_WORKER, ours)


def on_post_template(output_content: str, **_: Any) -> str:
    """The same for the page of an address that is not there."""
    return output_content.replace(_THEMES_WORKER, "js/worker.js")


def _outside(path: str, text: str) -> set[str]:
    """The repository's files outside of docs/ to which a page at `path` links."""
    targets = (_target(path, link) for _, link, _, _ in _LINK.findall(text))
    return {t for t in targets if t is not None and not t.startswith(("docs/", "../"))}


def _target(path: str, link: str) -> str | None:
    """The file that is meant, from the repository's root; None: not a file."""
    if "://" in link or link.startswith("mailto:"):
        return None
    return posixpath.normpath(posixpath.join(posixpath.dirname(path), link))


def _uri(target: str) -> str:
    return f"{_SOURCE}{target}.md"


def _page(target: str) -> str:
    """A file's page: Markdown as it is, a folder's files by name, anything else as it stands."""
    path = _ROOT / target
    if path.is_dir():
        names = sorted(p.name for p in path.iterdir() if not p.name.startswith(("_", ".")))
        return "\n".join([f"# {target}/", "", *(f"- `{name}`" for name in names)]) + "\n"
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return text
    return f"# {target}\n\n```{_LANGUAGES.get(path.suffix, 'text')}\n{text}```\n"
