"""Format, lint, types and the import contract, as tests: one command checks everything."""

import re
import subprocess
import sys
import sysconfig
import tomllib
from collections import defaultdict
from importlib import resources
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(sysconfig.get_path("scripts"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OPTIONAL = PROJECT["optional-dependencies"]
REQUIREMENTS = PROJECT["dependencies"] + [text for extra in OPTIONAL.values() for text in extra if not text.startswith("consat[")]
LOCK_LINES = [line for line in (ROOT / "requirements.lock").read_text().splitlines() if not line.startswith("#")]
LOCK: dict[str, set[str]] = defaultdict(set)
for pin in map(Requirement, LOCK_LINES):
    LOCK[canonicalize_name(pin.name)] |= {clause.version for clause in pin.specifier}


@pytest.mark.parametrize(
    "command", ["ruff check", "ruff format --check", "mypy", "lint-imports"], ids=["lint", "format", "types", "import-contract"]
)
def test_check_passes(command: str) -> None:
    tool, *arguments = command.split()
    done = subprocess.run([SCRIPTS / tool, *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"`{command}` says:\n{done.stdout}{done.stderr}"


def test_import_stays_light() -> None:
    heavy = {"clarabel", "matplotlib", "zenoh"}
    code = f"import sys, consat; print(*sorted({heavy} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def test_rounds_call_no_lapack() -> None:
    """On a CPU two LAPACK calls at once can wait for ever for the threads that they occupy; `lanewise` has what is needed."""
    sources = [path for room in ("protocols", "engine", "robots") for path in (ROOT / "src" / "consat" / room).rglob("*.py")]
    found = [path.name for path in sources if re.search(r"(jnp|lax|jsp)\.linalg\.(?!norm\b)|jax\.scipy\.linalg", path.read_text())]
    assert sources
    assert not found


def test_package_is_typed() -> None:
    assert resources.files("consat").joinpath("py.typed").is_file()


@pytest.mark.parametrize("text", REQUIREMENTS)
def test_lock_pins_requirement(text: str) -> None:
    requirement = Requirement(text)
    pins = LOCK.get(canonicalize_name(requirement.name))
    assert pins, f"{requirement.name} is not in requirements.lock; make it anew with the command in its first lines"
    assert all(requirement.specifier.contains(version) for version in pins), f"requirements.lock has {pins}, pyproject.toml wants {text}"


def test_lock_holds_nothing_but_pins() -> None:
    """No address of a registry, no path, no extra (pip takes none in a constraints file)."""
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+( ; [\w .'=<>!]+)?", line) for line in LOCK_LINES), LOCK_LINES
