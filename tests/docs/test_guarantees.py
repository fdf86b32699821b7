"""Every claim of docs/guarantees.md names tests that would refute it, and these are there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "guarantees.md").read_text(encoding="utf-8")
NAMED = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


def test_every_test_that_is_named_exists() -> None:
    named = NAMED.findall(PAGE)
    assert len(named) > 10
    for file, test in named:
        assert re.search(rf"^def {test}\(", (ROOT / file).read_text(encoding="utf-8"), flags=re.MULTILINE), f"{file}::{test}"


def test_every_claim_names_a_test() -> None:
    claims = [row for row in PAGE.splitlines() if row.startswith("| ")][1:]
    assert len(claims) > 10
    assert [row for row in claims if not NAMED.search(row.split(" | ")[-1])] == []


def test_the_readme_links_the_page() -> None:
    assert "(docs/guarantees.md)" in (ROOT / "README.md").read_text(encoding="utf-8")
