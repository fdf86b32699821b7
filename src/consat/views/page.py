"""A web page as one text, with its style, script and content security policy inside."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from importlib import resources

from consat import __version__


def page(name: str, styles: Sequence[str], parts: Mapping[str, str], sources: str = "") -> tuple[str, str]:
    """The page, and its policy, which allows its own script and style only.

    Args:
        name: name of the page's HTML and script in this package.
        styles: names of its style sheets.
        parts: texts that replace ``@key@`` in the HTML, by key.
        sources: further directives of the policy, each with a final semicolon.
    """
    files = resources.files("consat.views")
    html, script, *sheets = ((files / each).read_text(encoding="utf-8") for each in (f"{name}.html", f"{name}.js", *styles))
    style = "".join(sheets)
    ours, looks = (f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in (script, style))
    policy = f"default-src 'none'; script-src {ours}; style-src {looks}; {sources}base-uri 'none'; form-action 'none'"
    known = {"policy": policy, "version": __version__, "style": style, "script": script, **parts}
    return re.sub(r"@(\w+)@", lambda found: known[found[1]], html), policy
