"""Draw the pictures of docs/examples.md: python docs/figures/examples.py [NAME ..]. It runs the tasks of examples/ to their ends."""

import sys
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

import consat as cs
from consat.views import animation, figures

ROOT = Path(__file__).parents[2]
TARGET = Path(__file__).with_name("examples")
UNTIL = {"convoy": 30, "search": 40}
"""s, of teams that move."""


def escort(file: Path) -> cs.Result:
    """The run of examples/escort.py."""
    session = cs.Session(cs.load(file)).step(260)
    session.remove("left").change("right", "displacement(vehicle)", vector=[-0.8, -0.8]).step(280)
    return session.result()


def _small(picture: Figure, name: str) -> None:
    """Few colours make small files."""
    picture.savefig(TARGET / name, dpi=70)
    with Image.open(TARGET / name) as image:
        image.convert("RGB").quantize(255).save(TARGET / name, optimize=True)


TARGET.mkdir(exist_ok=True)
for file in sorted((ROOT / "examples").glob("*.yaml")):
    name = file.stem
    if sys.argv[1:] and name not in sys.argv[1:]:
        continue
    result = escort(file) if name == "escort" else cs.run(str(file), until=UNTIL.get(name))
    picture = figures.formation(result)
    assert picture is not None
    _small(picture, f"{name}.png")
    if name == "escort":
        animation.save(result, TARGET / "escort.gif", seconds=6)
    if name in ("escort", "search"):
        _small(figures.margins(result), f"{name}-margins.png")
