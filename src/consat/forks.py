"""A process that was forked from one that uses JAX must not compute.

JAX computes in threads, and a fork has none of them: whoever waits for one of them waits for ever. So forks are marked, and refused.
"""

from __future__ import annotations

import os
import sys

from consat.errors import ConsatError

_marked: set[int] = set()
"""Numbers of such processes: this one's, if it is one."""


def watch() -> None:
    """Mark every process that is forked from this one while JAX is in use."""
    if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork either
        os.register_at_fork(after_in_child=_mark)


def _mark() -> None:
    bridge = sys.modules.get("jax._src.xla_bridge")  # nothing public tells whether JAX is in use without taking it into use
    if bridge is not None and bridge.backends_are_initialized():
        _marked.add(os.getpid())


def refuse() -> None:
    """Raises: ConsatError: this process is such a fork."""
    if os.getpid() in _marked:
        raise ConsatError(
            "this process was forked from one that uses JAX, and would wait for JAX's threads for ever; start processes with spawn, "
            'such as multiprocessing.get_context("spawn").Pool(), or fork before anything is computed'
        )
