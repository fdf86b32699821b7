"""Refuses to compute in a process that was forked from one that uses JAX.

JAX computes in threads, which a forked process does not have, so a computation there would wait forever. Such processes are marked when
they are forked.
"""

from __future__ import annotations

import os
import sys

from consat.errors import ConsatError

_marked: set[int] = set()
"""Process ids of marked processes; contains the id of this process if it is one."""


def watch() -> None:
    """Mark each process that is forked from this one while JAX is in use."""
    if hasattr(os, "register_at_fork"):  # missing on Windows, which has no fork
        os.register_at_fork(after_in_child=_mark)


def _mark() -> None:
    bridge = sys.modules.get("jax._src.xla_bridge")  # no public function tells whether JAX is initialized without initializing it
    if bridge is not None and bridge.backends_are_initialized():
        _marked.add(os.getpid())


def refuse() -> None:
    """Raises: ConsatError: this process was forked from one that uses JAX."""
    if os.getpid() in _marked:
        raise ConsatError(
            "this process was forked from one that uses JAX, and would wait for JAX's threads for ever; start processes with spawn, "
            'such as multiprocessing.get_context("spawn").Pool(), or fork before anything is computed'
        )
