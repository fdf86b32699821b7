"""Every task of the gallery loads, runs, and has its picture; the escort, which loses a member, is run by tests/docs/test_readme.py."""

from pathlib import Path

import pytest

import consat as cs

ROOT = Path(__file__).parents[2]
TASKS = sorted(file.stem for file in (ROOT / "examples").glob("*.yaml"))
PAGE = (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", TASKS)
def test_a_task_is_short_and_has_its_picture(name: str) -> None:
    file = ROOT / "examples" / f"{name}.yaml"
    assert len(file.read_text(encoding="utf-8").splitlines()) <= 60
    assert f"(../examples/{name}.yaml)" in PAGE
    assert f"(figures/examples/{name}.png)" in PAGE
    assert (ROOT / "docs" / "figures" / "examples" / f"{name}.png").stat().st_size < 100_000


def test_the_escort_is_short() -> None:
    for file, most in (("escort.yaml", 30), ("escort.py", 25)):
        assert len((ROOT / "examples" / file).read_text(encoding="utf-8").splitlines()) <= most


@pytest.mark.parametrize("name", [name for name in TASKS if name != "escort"])
def test_a_task_is_satisfied_after_some_rounds(name: str) -> None:
    """The points that constraints see, at the first instant; what robots and moving constraints add is tested elsewhere."""
    team = cs.load(ROOT / "examples" / f"{name}.yaml").team.at(0.0)
    assert cs.run(team, protocol="admm", rounds=40).data["margin"].values.max() > 0
