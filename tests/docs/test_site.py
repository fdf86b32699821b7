"""The documentation site: its navigation and its lists are whole, and it is built without a warning and without anything from elsewhere."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

import consat
from consat.cli.commands import cli
from tools.reference import SCHEMA, commands, keys, schema_text

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
CONFIG = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))["project"]
LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "audio": "src", "embed": "src", "object": "data"}
"""What a page loads by itself, and by which attribute; of `link` see `_Page`."""


def listed(entries: Any) -> Iterator[str]:
    """The files of a navigation."""
    for entry in entries:
        for value in entry.values():
            yield from [value] if isinstance(value, str) else listed(value)


def test_every_page_is_in_the_navigation_and_every_entry_is_a_page() -> None:
    pages = {str(file.relative_to(DOCS)) for file in DOCS.rglob("*.md")}
    assert sorted(listed(CONFIG["nav"])) == sorted(pages)


def test_the_readme_leads_to_every_page() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    of_the_root = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
    assert [page for page in listed(CONFIG["nav"]) if f"({of_the_root.get(page, f'docs/{page}')})" not in text] == []


def test_the_reference_has_every_public_name_once() -> None:
    text = (DOCS / "reference" / "python.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^::: consat\.(\w+)$", text, flags=re.MULTILINE)) == sorted(consat.__all__)


def test_the_reference_has_every_option() -> None:
    text = commands()
    for name, command in cli.commands.items():
        section = text.split(f"## consat {name}\n")[1].split("\n## ")[0]
        for option in (option for each in command.params for option in each.opts if option.startswith("--")):
            assert option in section, f"consat {name} {option}"


def test_the_reference_has_every_key() -> None:
    text = keys()
    for key in (
        "`dimension`",
        "`scatter`",
        "`psi`",
        "`turn_rate`",
        "`vertices`",
        "`nu_beta`",
        "`from`",
        "`times`",
        "`box`",
        "`relaxation`",
    ):
        assert f"| {key}" in text, key


def test_the_published_schema_is_that_of_the_loader() -> None:
    assert SCHEMA.read_text(encoding="utf-8") == schema_text(), "write it anew: python tools/reference.py"


def test_every_place_in_the_code_that_the_paper_is_said_to_be_at_exists() -> None:
    named = re.findall(r"`(src/[\w/]+\.py)::(\w+)`", (DOCS / "paper.md").read_text(encoding="utf-8"))
    assert len(named) > 15
    for file, name in named:
        text = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"^(def|class) {name}\b|^{name}\b", text, flags=re.MULTILINE), f"{file}::{name}"


class _Page(HTMLParser):
    """Links and ids of a built page, and what it loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attributes}
        self.ids |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and given.get("rel") not in {"canonical", "prev", "next"}:
            self.loaded.append(given["href"])
        if tag in LOADS and LOADS[tag] in given:
            self.loaded.append(given[LOADS[tag]])


@pytest.mark.skipif(
    find_spec("zensical") is None or find_spec("latex2mathml") is None, reason="needs the extra docs: pip install '.[docs]'"
)
def test_the_site_is_built_strictly_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    """In a copy, whose pages show their examples without running them: `test_examples_of_a_document_run` does that."""
    for name in ("docs", "src", "tools", "examples", "CONTRIBUTING.md", "CHANGELOG.md", "zensical.toml"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    for page in (tmp_path / "docs").rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        page.write_text(re.sub(r' exec="on"[^\n]*\n(?!from tools)', "\n", text), encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "src")}
    words = [sys.executable, "-m", "zensical", "build", "--strict"]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "markdown_exec" not in done.stderr, done.stderr

    site = tmp_path / "build" / "site"
    pages = {file: _Page(file.read_text(encoding="utf-8")) for file in site.rglob("*.html") if file.name != "404.html"}
    assert len(pages) == len(list((tmp_path / "docs").rglob("*.md")))
    for file, page in pages.items():
        assert [each for each in page.loaded if urlsplit(each).scheme not in {"", "data"} or each.startswith("//")] == [], file
        for link in filter(lambda each: not urlsplit(each).scheme, page.links):
            target = (file.parent / unquote(urlsplit(link).path)).resolve() if urlsplit(link).path else file
            target = target / "index.html" if target.is_dir() else target
            assert target.is_file(), f"{file.relative_to(site)}: {link}"
            fragment = unquote(urlsplit(link).fragment)
            assert not fragment or target not in pages or fragment in pages[target].ids, f"{file.relative_to(site)}: {link}"
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(https?:)?//|@import", style.read_text(encoding="utf-8")), style
