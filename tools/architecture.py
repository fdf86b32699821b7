"""Draws docs/figures/architecture.svg from the imports: the rooms of src/consat in the order of pyproject.toml, and who imports whom.

    python tools/architecture.py          write the picture
    python tools/architecture.py --check  fail if it is not that of the code

Data flows down the picture and imports point up. An arrow is left out where others lead there by way of a room between.
"""

from __future__ import annotations

import argparse
import ast
import html
import sys
import tomllib
from pathlib import Path

import grimp

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "docs" / "figures" / "architecture.svg"
LEFT_OUT = {"__main__", "forks", "errors", "numerics", "settings"}
"""Modules that everybody may use."""
WIDTH, HEIGHT, GAP, ROW, SIDE = 250, 58, 26, 104, 110


def rows() -> list[list[str]]:
    """The rooms, from where data comes in to where it goes out; those of a row do not import one another."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(each["layers"] for each in contracts if each["containers"] == ["consat"])
    found = [[room.strip() for room in layer.split("|")] for layer in reversed(layers)]
    return [kept for row in found if (kept := [room for room in row if room not in LEFT_OUT])]


def imports(rooms: list[str]) -> set[tuple[str, str]]:
    """(importer, imported), between rooms, without those that a chain of others implies."""
    graph = grimp.build_graph("consat")
    members = {room: {f"consat.{room}", *graph.find_descendants(f"consat.{room}")} for room in rooms}
    whose = {module: room for room, modules in members.items() for module in modules}
    direct = {
        (whose[module], whose[other])
        for module in whose
        for other in graph.find_modules_directly_imported_by(module)
        if other in whose and whose[other] != whose[module]
    }
    # results are drawn by views when asked: imports within functions, which no room depends on
    direct -= {("results", "views"), ("problem", "views")}
    reach = {room: {b for a, b in direct if a == room} for room in rooms}
    for _ in rooms:
        reach = {room: found | {c for b in found for c in reach[b]} for room, found in reach.items()}
    return {(a, b) for a, b in direct if not any(b in reach[c] for x, c in direct if x == a and c != b)}


def said(room: str) -> str:
    """The first sentence of a room's docstring, as far as it fits."""
    path = ROOT / "src" / "consat" / room / "__init__.py"
    path = path if path.exists() else path.parent.with_suffix(".py")
    first = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n\n")[0].replace("\n", " ")
    text = first.split(": ")[0].split(". ")[0].split(", ")[0].replace("`", "")
    return text if len(text) <= 36 else text[:35] + "…"


def picture() -> str:
    """The SVG."""
    levels = rows()
    rooms = [room for row in levels for room in row]
    most = max(map(len, levels))
    width = most * (WIDTH + GAP) + GAP + 2 * SIDE
    place = {
        room: (width / 2 + (k - (len(row) - 1) / 2) * (WIDTH + GAP), GAP + level * ROW + HEIGHT / 2)
        for level, row in enumerate(levels)
        for k, room in enumerate(row)
    }
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {len(levels) * ROW + GAP - (ROW - HEIGHT) + GAP:g}"',
        'font-family="sans-serif" role="img" aria-label="The rooms of consat and their imports">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">',
        '<path d="M0 0L8 4L0 8z" fill="#555"/></marker></defs>',
        f'<rect width="{width:g}" height="100%" fill="#fff"/>',
    ]
    for a, b in sorted(imports(rooms)):
        (x, y), (u, v) = place[a], place[b]
        if abs(y - v) <= ROW + 1:
            way = f"M{x:g} {y - HEIGHT / 2:g}L{u:g} {v + HEIGHT / 2:g}"
        else:  # round the rooms between
            side = -1 if u < width / 2 or (u == width / 2 and x < width / 2) else 1
            out = width / 2 + side * (width / 2 - SIDE * (0.6 - 0.1 * (y - v) / ROW))
            way = f"M{x + side * WIDTH / 2:g} {y:g}C{out:g} {y:g} {out:g} {v:g} {u + side * WIDTH / 2:g} {v:g}"
        lines.append(f'<path d="{way}" fill="none" stroke="#555" stroke-width="1.4" marker-end="url(#tip)"/>')
    for room, (x, y) in place.items():
        lines.append(
            f'<rect x="{x - WIDTH / 2:g}" y="{y - HEIGHT / 2:g}" width="{WIDTH}" height="{HEIGHT}" rx="8" fill="#eaf3fa" stroke="#0072B2"/>'
        )
        lines.append(f'<text x="{x:g}" y="{y - 6:g}" text-anchor="middle" font-size="17" font-weight="bold">{room}</text>')
        lines.append(f'<text x="{x:g}" y="{y + 16:g}" text-anchor="middle" font-size="12" fill="#333">{html.escape(said(room))}</text>')
    return "\n".join([*lines, "</svg>"]) + "\n"


def main() -> None:
    """Write the picture, or check it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    made = picture()
    if not args.check:
        PICTURE.write_text(made, encoding="utf-8")
    elif not PICTURE.exists() or PICTURE.read_text(encoding="utf-8") != made:
        sys.exit(f"{PICTURE.relative_to(ROOT)} is not that of the code; draw it again: python tools/architecture.py")


if __name__ == "__main__":
    main()
