"""Checkpoints: the state of a run on disk, from which it resumes bit for bit. The file holds named arrays and JSON, no pickles."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from consat.errors import InvalidResult
from consat.problem.team import Team

SCHEMA = "consat.checkpoint/2"
NAME = "checkpoint.npz"
SHARE = 0.05
"""Largest fraction of a run's time for writing checkpoints."""
_META = "meta"


@dataclasses.dataclass
class Checkpoint:
    """Writes checkpoints, and restores the state of the run to resume.

    Attributes:
        path: path of the file.
        seconds: smallest time between two checkpoints, s.
        about: metadata needed to resume the run; JSON-serialisable.
        taken_up: arrays and metadata of the checkpoint to resume from; None for a new run.
    """

    path: Path
    seconds: float
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    taken_up: tuple[Mapping[str, np.ndarray], Mapping[str, Any]] | None = None
    _next: float = dataclasses.field(default_factory=time.monotonic)

    @property
    def turned(self) -> bool:
        """Whether the run to resume had switched to another layout of copies; see `consat.engine.rounds.Turn`."""
        return self.taken_up is not None and self.taken_up[1]["tally"].get("turned") is not None

    def due(self) -> bool:
        """Whether it is time for the next checkpoint."""
        return time.monotonic() >= self._next

    def write(self, state: Any, tally: Mapping[str, Any], problem: str) -> None:
        """Write a checkpoint, which replaces the last one atomically.

        Args:
            state: a pytree of arrays.
            tally: counters: scalars and arrays.
            problem: `fingerprint` of the run.
        """
        began = time.monotonic()
        arrays = {name: np.asarray(_plain(leaf)) for name, leaf in _named(state).items()}
        meta = json.dumps({"schema": SCHEMA, "problem": problem, "tally": dict(tally), **self.about}, default=np.ndarray.tolist)
        part = self.path.with_name(self.path.name + ".part")
        with part.open("wb") as file:
            np.savez(file, allow_pickle=False, **{_META: np.frombuffer(meta.encode(), dtype=np.uint8)}, **arrays)
            file.flush()
            os.fsync(file.fileno())
        part.replace(self.path)
        now = time.monotonic()
        self._next = now + max(self.seconds, (now - began) / SHARE)

    def restore(self, like: Any, problem: str) -> tuple[Any, Mapping[str, Any]] | None:
        """State and counters of the run to resume; None for a new run.

        Args:
            like: a state with the same structure, shapes and types.
            problem: `fingerprint` of the run.

        Raises:
            InvalidResult: the checkpoint belongs to another problem or to another version of consat.
        """
        if self.taken_up is None:
            return None
        arrays, meta = self.taken_up
        if meta["problem"] != problem:
            raise InvalidResult(f"{self.path}: this is the state of another team, protocol or setting; go on with the one that was stopped")
        leaves = []
        for name, leaf in _named(like).items():
            value, wanted = arrays.get(name), _plain(leaf)
            if value is None or value.shape != wanted.shape or value.dtype != wanted.dtype:
                raise InvalidResult(f"{self.path}: {name} is missing or of another kind; it was written by another version of consat")
            array = jnp.asarray(value)
            leaves.append(jax.random.wrap_key_data(array) if _is_key(leaf) else array)
        return jax.tree.unflatten(jax.tree.structure(like), leaves), meta["tally"]


def read(path: Path) -> tuple[Mapping[str, np.ndarray], Mapping[str, Any]]:
    """Arrays and metadata of a checkpoint file.

    Raises:
        InvalidResult: the file is missing or not a readable checkpoint of this schema.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        meta = json.loads(arrays.pop(_META).tobytes())
        schema = meta["schema"]
    except FileNotFoundError:
        raise InvalidResult(f"{path}: there is no checkpoint; `consat run FILE --out DIR --checkpoint` writes one") from None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidResult(f"{path}: this is no checkpoint of consat ({error})") from error
    if schema != SCHEMA:
        raise InvalidResult(f"{path}: this is a {schema!r}, but this version of consat reads {SCHEMA!r}")
    return arrays, meta


def scenario(path: Path) -> str | None:
    """Name of the scenario of a checkpoint; None if it has none. Other files raise the errors of `open`, `np.load` or `json.loads`."""
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        name: str | None = json.loads(file[_META].tobytes()).get("scenario_name")
    return name


def fingerprint(team: Team, *parts: Any) -> str:
    """Hash of the team's data and of everything else that determines a run.

    Args:
        team: the team.
        parts: arrays, and objects whose `repr` shows all their data.
    """
    digest = hashlib.sha256()

    def add(part: Any) -> None:
        if isinstance(part, np.ndarray | jax.Array):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.asarray(part).tobytes())
        else:
            digest.update(repr(part).encode())

    for part in (team.dimension, team.count, team.links, *parts):
        add(part)
    for family in team.families:
        add((family.kind, family.arity, family.sources))
        for array in (family.agents, family.owner, family.weight, *(family.parameters[key] for key in sorted(family.parameters))):
            add(array)
        for key in sorted(family.tracks):
            add(key)
            for array in family.tracks[key]:
                add(array)
    return digest.hexdigest()


def _named(state: Any) -> dict[str, Any]:
    return {"state" + jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(state)}


def _is_key(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))


def _plain(leaf: Any) -> Any:
    """A leaf as a plain array; the key data of a random key."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf
