"""The live page as text, for the server and for the widget."""

from __future__ import annotations

import base64
import hashlib
import re
from html import escape
from importlib import resources

from consat import __version__


def page(name: str, reach: str = "'none'") -> tuple[str, str]:
    """The page, and its content security policy, which allows its own script and style only.

    Args:
        name: title of the page.
        reach: source list of allowed connections.
    """
    views, own = resources.files("consat.views"), resources.files("consat.server")
    style = "".join((views / each).read_text(encoding="utf-8") for each in ("page.css", "live.css"))
    script, html = (views / "live.js").read_text(encoding="utf-8"), (own / "live.html").read_text(encoding="utf-8")
    hashes = [f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in (script, style)]
    policy = (
        f"default-src 'none'; script-src {hashes[0]}; style-src {hashes[1]}; connect-src {reach}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    parts = {"policy": policy, "version": __version__, "name": escape(name), "style": style, "script": script}
    return re.sub(r"@(\w+)@", lambda found: parts[found[1]], html), policy
