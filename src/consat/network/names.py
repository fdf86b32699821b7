"""Agents' ids may be any text; key expressions, certificates and file names may not."""

from __future__ import annotations

import hashlib
from typing import Final
from urllib.parse import quote

LONGEST: Final = 64
"""Characters of a certificate's common name (RFC 5280, ub-common-name)."""


def spelled(text: str) -> str:
    """The text in letters, digits and ``_-~%``, at most `LONGEST` of them; different texts differ.

    Everything else is percent-encoded, the dot too: `..` is a directory. What is longer is told by its hash, in the form ``%%…`` that no
    encoding has.
    """
    name = quote(text, safe="").replace(".", "%2E")
    return name if len(name) <= LONGEST else "%%" + hashlib.sha256(text.encode()).hexdigest()[: LONGEST - 2]
