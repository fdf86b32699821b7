"""Draw the pictures of docs/examples.md: python docs/figures/examples.py. It runs every task of examples/ to its end."""

from pathlib import Path

import consat as cs
from consat.views import animation, figures

ROOT = Path(__file__).parents[2]
TARGET = Path(__file__).with_name("examples")
UNTIL = {"convoy": 30, "search": 30}
"""s, of teams that move."""

TARGET.mkdir(exist_ok=True)
for file in sorted((ROOT / "examples").glob("*.yaml")):
    name = file.stem
    if name == "escort":  # with the member that is lost
        session = cs.Session(cs.load(file)).step(260)
        session.remove("left").change("right", "displacement(vehicle)", vector=[-0.8, -0.8]).step(280)
        result = session.result()
        figures.margins(result).savefig(TARGET / "escort-margins.png", dpi=75)
        animation.save(result, TARGET / "escort.gif", seconds=6)
    else:
        result = cs.run(str(file), until=UNTIL.get(name))
    picture = figures.formation(result)
    assert picture is not None
    picture.savefig(TARGET / f"{name}.png", dpi=75)
    if name == "search":
        figures.margins(result).savefig(TARGET / "search-margins.png", dpi=75)
