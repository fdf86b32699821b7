"""The browser that tests of pages drive. Where it is missing they are skipped; with CONSAT_BROWSER=required, as in .ci/run, they fail."""

import importlib.util
import os
import shutil

import pytest

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
MISSING = "there is no Chromium; on Debian: apt-get install chromium" if BROWSER is None else ""
if not MISSING and importlib.util.find_spec("playwright") is None:
    MISSING = "there is no playwright; pip install playwright"
if MISSING and os.environ.get("CONSAT_BROWSER") == "required":
    pytest.fail(MISSING, pytrace=False)
needs_browser = pytest.mark.skipif(bool(MISSING), reason=MISSING)
