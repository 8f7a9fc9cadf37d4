"""A hook of mkdocs: pages link to files all over the repository, as on a Git host; what they link to becomes a part of the site."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

DOCS, ROOT = Path(__file__).parent, Path(__file__).parents[1]

# Folders that pages link to, which a Git host lists: the page that stands for each in the site.
FOLDERS = {ROOT / "examples": DOCS / "extend.md", ROOT / "benchmarks": ROOT / "benchmarks/README.md"}

# A Markdown link or image whose target is a relative path: what stands before the target, the target, the anchor.
LINK = re.compile(r"(\]\()([^)#:\s]+)(#[^)\s]*)?(?=\))")

# Not inside of code, where brackets are something else.
CODE = re.compile(r"(^```.*?^```$|`[^`\n]+`)", re.DOTALL | re.MULTILINE)


def on_files(files: Files, config: Any) -> Files:
    """Add every file outside of docs/ that a page links to, and what those pages link to."""
    known, pages = set(), sorted(DOCS.glob("*.md"))
    while pages:
        page = pages.pop()
        for target in linked(page):
            if target.is_file() and DOCS not in target.parents and target not in known:
                known.add(target)
                files.append(File.generated(config, target.relative_to(ROOT).as_posix(), abs_src_path=str(target)))
                pages += [target] if target.suffix == ".md" else []
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Point links at where files lie in the site: those of docs/ at its top, all others below it as in the repository."""
    source = Path(page.file.abs_src_path)
    parts = CODE.split(markdown)
    return "".join(part if odd % 2 else LINK.sub(lambda link: _moved(link, source, page.file.src_uri), part) for odd, part in enumerate(parts))


def linked(page: Path) -> list[Path]:
    """The files and folders of the repository that a page links to by relative paths."""
    parts = CODE.split(page.read_text(encoding="utf-8"))
    return [(page.parent / link[2]).resolve() for part in parts[::2] for link in LINK.finditer(part)]


def _moved(link: re.Match[str], source: Path, uri: str) -> str:
    target = (source.parent / link[2]).resolve()
    target = FOLDERS.get(target, target)
    place = target.relative_to(DOCS if DOCS in target.parents else ROOT).as_posix()
    return f"{link[1]}{os.path.relpath(place, os.path.dirname(uri) or '.')}{link[3] or ''}"
