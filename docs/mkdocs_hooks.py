"""Hooks of MkDocs for ``mkdocs.yml``: pages outside of docs/, and links to files of the repository.

The pages are written for readers of the repository, with GitHub's Markdown: their links name files of the
repository. On the site such a link leads to the page that is made of the file, or to a copy of the file.
"""

import logging
import os
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "deploy/README.md": "deployment.md",
    "examples/README.md": "examples.md",
}
"""Pages of the site by their files outside of docs/."""
_COPIES = "source/"
"""Folder of the site that holds copies of linked files which are no pages."""
_log = logging.getLogger("mkdocs.hooks.site")  # a warning here fails a strict build
_FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(?P<text>!?\[[^\]]*\])\((?P<target>[^)\s]+)\)")
_NESTED_ITEM = re.compile(r"^ {2,3}(?=[-*] |\d+\. )", re.MULTILINE)


def slug(heading: str, separator: str = "-") -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.replace("`", "").lower()).replace(" ", separator)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Give headings the anchors that they have on GitHub."""
    config.mdx_configs.setdefault("toc", {})["slugify"] = slug
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages outside of docs/, and copies of the files that pages link to."""
    for origin, uri in OUTSIDE.items():
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / origin)))
    copies = {path for page in files.documentation_pages() for path in _linked_files(page)}
    for path in sorted(copies):
        if path.endswith(".md"):
            _log.warning("%s, to which a page links, is no page: add it to OUTSIDE", path)
        else:
            files.append(File.generated(config, _COPIES + path, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to the site, and indent nested lists as Python-Markdown reads them."""
    parts = _FENCE.split(markdown)  # code blocks are the odd ones
    for number in range(0, len(parts), 2):
        parts[number] = _NESTED_ITEM.sub("    ", parts[number])
        parts[number] = _LINK.sub(lambda link: _led(link, page.file), parts[number])
    return "".join(parts)


def _led(link: re.Match[str], page: File) -> str:
    """Return a link of a page as the site needs it; of a link to a folder, which the site lacks, its text."""
    path, anchor = _path(link["target"], page)
    if path is None:
        return link[0]
    if (uri := _uri(path)) is None:
        return link["text"].strip("[]")
    return f"{link['text']}({posixpath.relpath(uri, posixpath.dirname(page.src_uri) or '.')}{anchor})"


def _linked_files(page: File) -> Iterator[str]:
    """Yield the files outside of docs/ that a page links to and that are no pages of the site."""
    for link in _LINK.finditer(_FENCE.sub("", page.content_string)):
        path, _ = _path(link["target"], page)
        if path is not None and (_uri(path) or "").startswith(_COPIES):
            yield path


def _path(target: str, page: File) -> tuple[str | None, str]:
    """Return the path in the repository that a link names, None if it names none, and its anchor with "#"."""
    path, mark, anchor = target.partition("#")
    if not path or "://" in path or path.startswith("mailto:"):
        return None, ""
    origin = {uri: outside for outside, uri in OUTSIDE.items()}.get(page.src_uri, f"docs/{page.src_uri}")
    return os.path.normpath(posixpath.join(posixpath.dirname(origin), path)), mark + anchor


def _uri(path: str) -> str | None:
    """Return the file of the site for a path in the repository; None for a folder."""
    if path in OUTSIDE:
        return OUTSIDE[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return None if (ROOT / path).is_dir() else _COPIES + path
