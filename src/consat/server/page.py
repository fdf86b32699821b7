"""The page of the view as text, for a server to serve or for a widget to frame."""

from __future__ import annotations

import base64
import hashlib
import re
from html import escape
from importlib import resources

from consat import __version__


def page(name: str, reach: str = "'none'") -> tuple[str, str]:
    """The page, and the policy that lets it run what it came with and nothing else.

    Args:
        name: its title.
        reach: what it may connect to, as a content security policy has it.
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
