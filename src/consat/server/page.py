"""The live page as text, for the server and for the widget."""

from html import escape

from consat.views.page import page as assembled


def page(name: str, reach: str = "'none'") -> tuple[str, str]:
    """The page with a title, and its content security policy. reach: source list of the connections that it allows."""
    return assembled("live", ("page.css", "live.css"), {"name": escape(name)}, f"connect-src {reach}; img-src data:; ")
