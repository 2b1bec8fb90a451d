"""Every relative link of every Markdown page leads to an existing file, and every anchor to one of its headings."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("dentine", "services", "deploy", "docs", "tests")
FENCE = re.compile(r"^ {0,3}(```|~~~).*?^ {0,3}\1", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)", re.DOTALL)
LINK = re.compile(r"\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
HEADING = re.compile(r"^#{1,6}\s+(.+?)\s*#*$", re.MULTILINE)
ELSEWHERE = re.compile(r"[a-z][a-z0-9+.-]*:|//", re.IGNORECASE)


def pages() -> list[Path]:
    """Markdown files of the project, in its root and in its folders except those of installed packages."""
    below = (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.md"))
    return sorted([*ROOT.glob("*.md"), *(path for path in below if "node_modules" not in path.parts)])


def anchors(text: str) -> set[str]:
    """Anchors of a page's headings, formed as code hosts do: lower case, hyphens for spaces, no punctuation or symbols,
    and a number after a name that occurred before.
    """
    seen: Counter[str] = Counter()
    names: set[str] = set()
    for heading in HEADING.findall(FENCE.sub("", text)):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        name = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        names.add(f"{name}-{seen[name]}" if seen[name] else name)
        seen[name] += 1
    return names


def links(text: str) -> Iterator[str]:
    """Relative targets of links and pictures outside code."""
    prose = CODE.sub("", FENCE.sub("", text))
    return (target for target in LINK.findall(prose) if not ELSEWHERE.match(target))


def broken_links(page: Path) -> list[str]:
    text = page.read_text()
    broken = []
    for link in links(text):
        name, _, anchor = link.partition("#")
        target = (page.parent / name) if name else page
        if not target.exists():
            broken.append(f"{link}: there is no such file")
        elif anchor and (target.suffix != ".md" or anchor not in anchors(target.read_text())):
            broken.append(f"{link}: there is no such heading")
    return broken


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    assert broken_links(page) == []


def test_every_page_of_the_documentation_is_in_its_index() -> None:
    index = ROOT / "docs" / "index.md"
    listed = {(index.parent / link.partition("#")[0]).resolve() for link in links(index.read_text())}
    assert set((ROOT / "docs").rglob("*.md")) - {index} <= listed


@pytest.mark.parametrize(
    ("link", "is_broken"),
    [
        ("other.md", False),
        ("other.md#the--of-a-fit", False),
        ("other.md#twice-1", False),
        ("#here", False),
        ("https://elsewhere.example/page", False),
        ("missing.md", True),
        ("other.md#missing", True),
        ("other.md#in-a-fence", True),
        ("#twice", True),
    ],
)
def test_a_broken_link_is_told(tmp_path: Path, link: str, is_broken: bool) -> None:
    (tmp_path / "other.md").write_text("# The ± of a fit\n## Twice\n## Twice\n```\n# In a fence\n```\n")
    page = tmp_path / "page.md"
    page.write_text(f"# Here\n`[code](nowhere.md)` and a [link\nover two lines]({link})\n")
    assert bool(broken_links(page)) == is_broken
