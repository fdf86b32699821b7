"""Agents' ids may be any text; key expressions, certificates and file names may not."""

from __future__ import annotations

import hashlib
from typing import Final
from urllib.parse import quote

from consat.errors import NetworkError, shown

LONGEST: Final = 64
"""Characters of a certificate's common name (RFC 5280, ub-common-name)."""


def spelled(text: str) -> str:
    """The text in letters, digits and ``_-~%``, at most `LONGEST` of them; different texts differ.

    Everything else is percent-encoded, the dot too: `..` is a directory. What is longer is told by its hash, in the form ``%%…`` that no
    encoding has.
    """
    try:
        name = quote(text, safe="").replace(".", "%2E")
    except UnicodeEncodeError:
        raise NetworkError(f"a name must be text that UTF-8 can write, but {shown(text)} is not") from None
    if not name:
        raise NetworkError("a name must not be empty")
    return name if len(name) <= LONGEST else "%%" + hashlib.sha256(text.encode()).hexdigest()[: LONGEST - 2]
