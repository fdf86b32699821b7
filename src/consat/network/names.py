"""Names of key files, and the encoding of agents' ids, which may be any text, for key expressions, certificates and file names."""

from __future__ import annotations

import hashlib
from typing import Final
from urllib.parse import quote

from consat.errors import NetworkError, shown

CA: Final = "ca.pem"
CA_KEY: Final = "ca-key.pem"
CERTIFICATE: Final = "certificate.pem"
KEY: Final = "key.pem"
"""Names of key files. No agent's folder has such a name, because an encoded id has no dot."""
LONGEST: Final = 64
"""Most characters of a certificate's common name (RFC 5280, ub-common-name)."""


def spelled(text: str) -> str:
    """Encode a text in at most `LONGEST` letters, digits and ``_-~%``. Different texts have different encodings.

    All other characters are percent-encoded. The dot is encoded, too, because ``..`` is a directory. If the encoding is too long, it is
    ``%%`` and a part of the text's SHA-256 hash; no percent-encoding begins with ``%%``.

    Raises:
        NetworkError: the text is empty, or UTF-8 cannot encode it.
    """
    try:
        name = quote(text, safe="").replace(".", "%2E")
    except UnicodeEncodeError:
        raise NetworkError(f"a name must be text that UTF-8 can write, but {shown(text)} is not") from None
    if not name:
        raise NetworkError("a name must not be empty")
    return name if len(name) <= LONGEST else "%%" + hashlib.sha256(text.encode()).hexdigest()[: LONGEST - 2]
