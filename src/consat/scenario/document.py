"""YAML 1.2 as plain data with the line and column of each value. Tags never construct objects.

ruamel.yaml's parser yields events, and this module builds the tree. So it knows the place of each value, can report repeated keys, and can
refuse a hostile file before it costs time or memory. Anchors and aliases are refused, too.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Final

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, StreamMark, YAMLError
from ruamel.yaml.events import (
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    Event,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
)

from consat.errors import AT_KEY, Fault, InvalidScenario, Place, shown

LARGEST: Final = 16 * 2**20
"""Largest size of a file, bytes."""
DEEPEST: Final = 40
"""Largest nesting depth of a file."""

Path = tuple[str | int, ...]

_NO_TEXT = re.compile("[^\t\n\r -~\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_INTEGER = re.compile(r"[-+]?[0-9]{1,300}|0o[0-7]{1,300}|0x[0-9a-fA-F]{1,200}")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS = {word: value for name, value in (("true", True), ("false", False), ("null", None)) for word in (name, name.title(), name.upper())}
_WORDS |= {"": None, "~": None}

_IN_PLAIN_WORDS: Final = (
    (r"character '\\t'", "a tab stands here; indent and separate with spaces"),
    (r"character '(.)' that cannot start", "a text that starts with {} must stand in quotes"),
    (r"mapping values are not allowed", "a ':' stands where no key can be; check the indentation, and put text with a ': ' in quotes"),
    (r"expected ',' or '(.)'", "a comma between entries or the closing {} is missing"),
    (r"expected <block end>, but found '([\]},])'", "there is one {} too many"),
    (r"expected <block end>", "the indentation does not fit the lines above; entries of one list or mapping start in the same column"),
    (r"unexpected end of stream", "a quote is opened, but never closed"),
    (r"could not find expected ':'", "a key needs a ':' and a value, e.g. radius: 1"),
    (r"node content, but found '(.+)'", "a value is missing before {}"),
    (r"<document start>", "there is more text where the file should end; are brackets closed too early?"),
    (r"C int|chr\(\)", "a \\U within double quotes names no character"),
    (r"escape character '(.+)'", "\\{} means nothing within double quotes; write \\\\ or use single quotes"),
)


@dataclass(slots=True)
class Node:
    """One value of the file, with its place.

    Attributes:
        value: a text, number, boolean or None; a list of nodes; or a dict of nodes.
        place: where the value starts.
        key: where its key starts; None if it has no key.
        indent: number of columns between `place` and its text: 1 for a quoted text, else 0. None if the text does not stand in the file
            unchanged on one line.
    """

    value: Any
    place: Place
    key: Place | None = None
    indent: int | None = None

    @property
    def plain(self) -> Any:
        """The value as plain data, without places."""
        if isinstance(self.value, dict):
            return {key: node.plain for key, node in self.value.items()}
        return [node.plain for node in self.value] if isinstance(self.value, list) else self.value


@dataclass
class Document:
    """A parsed file.

    Attributes:
        file: name of the file, for messages.
        root: the value of the whole file; None if the file is empty.
        faults: faults found so far, with their places.
    """

    file: str
    root: Node | None = None
    faults: list[Fault] = field(default_factory=list)

    def place(self, path: Path, offset: int = 0) -> Place:
        """The place of a value in the file.

        Args:
            path: path of the value. If there is no such value, the place is that of the deepest existing ancestor.
            offset: number of characters into the text of the value; or `AT_KEY` for the place of its key.
        """
        node = self.root
        if node is None:
            return Place(1, 1, self.file)
        for part in path:
            inner = node.value.get(part) if isinstance(node.value, dict) else None
            if isinstance(node.value, list) and isinstance(part, int) and part < len(node.value):
                inner = node.value[part]
            if inner is None:
                return node.place
            node = inner
        if offset == AT_KEY:
            return node.key or node.place
        line, column, file = node.place
        return Place(line, column + offset + node.indent, file) if offset and node.indent is not None and line else node.place

    def invalid(self, faults: Iterable[Fault] = ()) -> InvalidScenario:
        """An error with the given faults and those of the document, each with its place, in the order of the file."""
        placed = {*self.faults, *(replace(fault, place=self.place(fault.path, fault.offset)) for fault in faults)}
        return InvalidScenario(sorted(placed, key=lambda fault: (fault.place, fault.message)))

    def broken(self, message: str, place: Place) -> InvalidScenario:
        """An error for a file that cannot be read any further; includes the faults found so far."""
        self.faults.append(Fault((), message, "YAML", place=place))
        return self.invalid()


def decode(content: bytes, file: str) -> str:
    """The text of a file, from its bytes.

    Raises:
        InvalidScenario: the file is larger than `LARGEST`, or not UTF-8.
    """
    if len(content) > LARGEST:
        message = f"the file is larger than {LARGEST // 2**20} MB; no scenario needs that"
        raise Document(file).broken(message, Place(1, 1, file))
    try:
        return content.removeprefix(BOM_UTF8).decode()
    except UnicodeDecodeError as error:
        before = content.removeprefix(BOM_UTF8)[: error.start].decode()
        place = Place(before.count("\n") + 1, len(before) - before.rfind("\n"), file)
        raise Document(file).broken("there is a byte that is no UTF-8, but a scenario is text in UTF-8", place) from None


def read(text: str, file: str, place: Callable[[StreamMark], Place] | None = None) -> Document:
    """Parse YAML.

    Args:
        text: the YAML.
        file: name of the file, for messages.
        place: function from a parser mark to a place. If None, the place is the line and column of the mark.

    Raises:
        InvalidScenario: the text is not YAML, or uses YAML that is not supported. Lesser faults, such as repeated keys, are left in
            `Document.faults`.
    """
    document = Document(file)
    where = place or (lambda mark: Place(mark.line + 1, mark.column + 1, file))
    if (bad := _NO_TEXT.search(text)) is not None:
        before = text[: bad.start()]
        mark = StreamMark(file, bad.start(), before.count("\n"), bad.start() - before.rfind("\n") - 1)
        raise document.broken(f"there is a character U+{ord(bad[0]):04X}, but a scenario is text", where(mark))
    reader = _Reader(YAML(typ="safe", pure=True).parse(text), document, where)
    try:
        document.root = reader.root()
    except MarkedYAMLError as error:
        marks = [error.problem_mark, error.context_mark]
        if "end of stream" in str(error.problem) or "<stream end>" in str(error.problem):
            marks.reverse()  # an unclosed quote or bracket is reported where it opens
        at = where(marks[0] or marks[1] or reader.mark)
        raise document.broken(_in_plain_words(str(error.problem)), at) from None
    except InvalidScenario:
        raise
    except (YAMLError, ArithmeticError, ValueError) as error:  # ruamel.yaml raises one of the latter for an escape such as "\UFFFFFFFF"
        raise document.broken(_in_plain_words(str(error)), where(reader.mark)) from None
    return document


class _Reader:
    """Builds nodes from the events of the parser."""

    def __init__(self, events: Iterator[Event], document: Document, place: Callable[[StreamMark], Place]) -> None:
        self.events = events
        self.document = document
        self.place = place
        self.mark = StreamMark(document.file, 0, 0, 0)

    def next(self) -> Event:
        event = next(self.events)
        self.mark = event.start_mark
        return event

    def root(self) -> Node | None:
        self.next()  # the start of the stream
        start = self.next()
        if not isinstance(start, DocumentStartEvent):
            return None
        if start.version not in (None, (1, 2)):
            self.fault((), "the %YAML line asks for another version, but consat reads YAML 1.2; remove it")
        root = self.value(self.next(), ())
        self.next()  # the end of the document
        if isinstance(self.next(), DocumentStartEvent):
            self.fault((), "a second document starts here, but a scenario is one document; remove what follows")
            raise self.document.invalid()
        return root

    def value(self, event: Event, path: Path) -> Node:
        place = self.place(event.start_mark)
        if isinstance(event, NodeEvent) and event.anchor is not None:
            self.fault(
                path,
                "anchors (&) and aliases (*) are not part of a scenario; write the value itself, text in quotes; agents alike are a group",
            )
        elif isinstance(event, ScalarEvent | CollectionStartEvent) and event.tag is not None:
            self.fault(path, "tags (!) are not part of a scenario; remove it, or put text that starts with ! in quotes")
        if isinstance(event, ScalarEvent):
            return _scalar(event, place)
        if not isinstance(event, CollectionStartEvent):
            return Node(None, place)
        if len(path) >= DEEPEST:
            self.fault(path[:1], f"nested deeper than {DEEPEST} levels; no scenario needs that")
            raise self.document.invalid()
        return Node(self.mapping(path) if isinstance(event, MappingStartEvent) else list(self.items(path)), place)

    def items(self, path: Path) -> Iterator[Node]:
        index = 0
        while not isinstance(event := self.next(), CollectionEndEvent):
            yield self.value(event, (*path, index))
            index += 1

    def mapping(self, path: Path) -> dict[str, Node]:
        entries: dict[str, Node] = {}
        while not isinstance(event := self.next(), CollectionEndEvent):
            key, place = str(getattr(event, "value", "?")), self.place(event.start_mark)
            if not isinstance(event, ScalarEvent):
                self.fault(path, "a key must be plain text, such as radius")
            self.value(event, (*path, key))
            if key in entries:
                self.fault((*path, key), f"the key {shown(key)} stands here for the second time; keep one")
            node = self.value(self.next(), (*path, key))
            node.key = place
            node.place = place if node.value is None else node.place
            if isinstance(event, ScalarEvent):
                entries.setdefault(key, node)
        return entries

    def fault(self, path: Path, message: str) -> None:
        self.document.faults.append(Fault(path, message, "YAML", place=self.place(self.mark)))


def _scalar(event: ScalarEvent, place: Place) -> Node:
    text = event.value
    raw = event.end_mark.index - event.start_mark.index if event.end_mark.line == event.start_mark.line else -1
    if event.style:
        return Node(text, place, indent=1 if raw == len(text) + 2 else None)
    return Node(resolve(text), place, indent=0 if raw == len(text) else None)


def resolve(text: str) -> Any:
    """The value of an unquoted text, by the core schema of YAML 1.2. Integers of more than 300 digits become floats."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text, 8 if text.startswith("0o") else 16 if text.startswith("0x") else 10)
    if _FLOAT.fullmatch(text):
        return float(re.sub(r"\.(?=inf|nan)", "", text.lower()))
    return text


def _in_plain_words(problem: str) -> str:
    problem = problem.partition("\n")[0]
    for pattern, words in _IN_PLAIN_WORDS:
        if match := re.search(pattern, problem):
            return words.format(*match.groups())
    return f"cannot be read as YAML ({problem})"
