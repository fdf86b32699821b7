"""``--set path=value``: changes values of a scenario before it is checked."""

from __future__ import annotations

from dataclasses import replace

from consat.errors import Fault, InvalidScenario, Place, closest, dotted, shown
from consat.scenario.document import Document, Node, Path, read


def override(document: Document, text: str) -> None:
    """Change one value of a document. Faults of `text` are added to those of the document.

    Args:
        document: the document to change.
        text: ``path=value``. The path has dots between keys, indices from 0, and ids of agents, e.g. ``agents.a1.constraints.0.radius``.
            Missing keys are created. The value is YAML; an empty value removes the key.
    """
    dots, equals, value = text.partition("=")
    place = Place(0, 0, "--set " + "".join(char if char.isprintable() else "?" for char in text[:120]))
    parts = dots.strip().split(".")
    if not equals or not all(parts):
        message = "this must be PATH=VALUE with a dotted path, such as start.seed=3 or agents.a1.constraints.0.radius=2"
        document.faults.append(Fault((), message, "path", place=place))
        return
    try:
        new = read(value, place.file, lambda _: place)
    except InvalidScenario as error:
        document.faults += error.faults
        return
    document.faults += [replace(fault, path=()) for fault in new.faults]  # their paths start at the value, not at the root of the document
    node = new.root or Node(None, place)
    node.place = node.key = place
    document.root = document.root or Node({}, place)
    _put(document.root, parts, node, document, ())


def _put(parent: Node, parts: list[str], new: Node, document: Document, path: Path) -> None:
    """Insert a node into the tree.

    Args:
        parent: node at which `parts` start.
        parts: keys and indices that lead to the place of the new node.
        new: the node to insert.
        document: receives faults.
        path: path of `parent`.
    """
    part, *rest = parts
    if parent.value is None:
        parent.value, parent.place = {}, new.place
    if isinstance(parent.value, list):
        index = _index(parent.value, part)
        if index is None:
            ids = [name for name in map(_id, parent.value) if name is not None]
            many = f"counted from 0 to {len(parent.value) - 1}" if parent.value else "which is empty"
            message = f"there is no entry {shown(part)} in {dotted(path)}, {many}{closest(part, ids)}"
            document.faults.append(Fault(path, message, "path", place=new.place))
        elif rest:
            _put(parent.value[index], rest, new, document, (*path, index))
        else:
            parent.value[index] = new
    elif isinstance(parent.value, dict):
        if rest:
            _put(parent.value.setdefault(part, Node(None, new.place, new.place)), rest, new, document, (*path, part))
        elif new.value is None:
            parent.value.pop(part, None)
        else:
            parent.value[part] = new
    else:
        message = f"{dotted(path)} is {shown(parent.value)}, which has no entry {shown(part)}"
        document.faults.append(Fault(path, message, "path", place=new.place))


def _index(nodes: list[Node], part: str) -> int | None:
    """The index of the list entry with this id, name or number; None if there is none."""
    by_id = next((index for index, node in enumerate(nodes) if _id(node) == part), None)
    if by_id is None and part.isascii() and part.isdigit() and len(part) < 10 and int(part) < len(nodes):
        return int(part)
    return by_id


def _id(node: Node) -> str | None:
    """The id or name of a list entry; None if it has none."""
    if not isinstance(node.value, dict):
        return None
    name = next((node.value[key].value for key in ("id", "name") if key in node.value), None)
    return name if isinstance(name, str) else None
