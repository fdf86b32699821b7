"""A Markdown extension of the site: mathematics as MathML, files that examples read, links to files outside docs/.

* ``$x^2$`` and fences of ``math`` become MathML while the site is built, so that nothing is loaded to show them.
* A fence with a title, such as ``yaml title="team.yaml"``, is written to the folder that the examples run in.
* Links to ``../examples/NAME`` lead to the listing of that file on the page of examples.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import sysconfig
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from markdown.preprocessors import Preprocessor
from markdown.treeprocessors import Treeprocessor

from consat.network.deploy.environment import keep_compilations

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "examples"
"""The examples of the pages run here."""
TITLED = re.compile(r'^```\w+ title="([\w.-]+)"\n(.*?)^```$', flags=re.MULTILINE | re.DOTALL)


def mathematics(latex: str, *, block: bool = False) -> str:
    """LaTeX as MathML."""
    return convert(latex, display="block" if block else "inline").replace('xmlns="http://www.w3.org/1998/Math/MathML" ', "")


def fence(source: str, language: str, css_class: str, options: Any, md: Markdown, **rest: Any) -> str:
    """A fence of ``math``."""
    return f'<div class="equation">{mathematics(source, block=True)}</div>'


class _Inline(InlineProcessor):
    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str, int, int]:  # type: ignore[override]  # noqa: N802
        return self.md.htmlStash.store(mathematics(m[1])), m.start(0), m.end(0)


class _Files(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        for name, text in TITLED.findall("\n".join(lines)):
            (WORK / name).write_text(text, encoding="utf-8")
        return lines


class _Links(Treeprocessor):
    def run(self, root: Element) -> None:
        for link in root.iter("a"):
            if (target := link.get("href", "")).startswith("../examples"):
                name = target.removeprefix("../examples").strip("/").replace(".", "-")
                link.set("href", f"examples.md#{name or 'the-files'}")


class Site(Extension):
    """See the module."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
        md.preprocessors.register(_Files(md), "files", 100)  # before fences are taken out
        md.inlinePatterns.register(_Inline(r"(?<![\\$\w])\$([^$\s](?:[^$\n]*[^$\s])?)\$(?![\w$])", md), "mathematics", 185)  # after code
        md.treeprocessors.register(_Links(md), "links", 19)  # right after links are there


def makeExtension(**options: Any) -> Site:  # noqa: N802
    """Found by this name."""
    return Site(**options)


if Path.cwd() != WORK:  # the examples run in a fresh folder, where they find `tools` and `consat`
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    sys.path.insert(0, str(ROOT))
    os.chdir(WORK)
    os.environ["PATH"] = os.pathsep.join([sysconfig.get_path("scripts"), os.environ["PATH"]])
    os.environ["MPLBACKEND"] = "Agg"
    keep_compilations(os.environ)
