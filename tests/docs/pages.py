"""The pages of the documentation, and what can be read in them."""

import re
from pathlib import Path

from docs.mkdocs_hooks import slug

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").glob("*.md"),
        ROOT / "deploy/README.md",
        ROOT / "examples/README.md",
    ]
)

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INDENTED = re.compile(r"(?:^ {4}.*\n)+", re.MULTILINE)
_SPAN = re.compile(r"`([^`\n]+)`")
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


def name(page: Path) -> str:
    """Return the path of a page within the repository."""
    return page.relative_to(ROOT).as_posix()


def prose(page: Path) -> str:
    """Return a page without its code blocks."""
    return _FENCE.sub("", page.read_text(encoding="utf-8"))


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced code blocks of a language."""
    return [code for tag, code in _FENCE.findall(page.read_text(encoding="utf-8")) if tag == language]


def spans(page: Path) -> list[str]:
    """Return the inline code of a page."""
    return _SPAN.findall(prose(page))


def commands(page: Path) -> list[str]:
    """Return the command lines of a page: inline code, and lines of blocks without their comments."""
    text = page.read_text(encoding="utf-8")
    lines = [
        line.split("  #")[0].strip()
        for block in [*(code for _, code in _FENCE.findall(text)), *_INDENTED.findall(_FENCE.sub("", text))]
        for line in block.replace("\\\n", " ").splitlines()
    ]
    return [*lines, *spans(page)]


def links(page: Path) -> list[str]:
    """Return the targets of a page's links and pictures."""
    return _LINK.findall(prose(page))


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    return {slug(heading) for heading in _HEADING.findall(prose(page))}
