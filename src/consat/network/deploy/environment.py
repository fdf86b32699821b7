"""What the environment of an agent's process must hold before JAX starts: one thread, and compiled programs kept between runs."""

from __future__ import annotations

import os
import platform
from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_LOG_LEVEL, _OF_JAX = "TF_CPP_MIN_LOG_LEVEL", "1"
"""What XLA writes on stderr, and what JAX asks for where nobody does, which its subprocesses inherit."""
ONE_THREAD: Final = "--xla_cpu_multi_thread_eigen=false"
ROUND_EACH: Final = "--xla_cpu_max_isa=AVX"
"""Without fused multiply-add every product is rounded by itself, so that a result does not depend on what XLA computes beside it."""


def prepare(environment: MutableMapping[str, str], *, exact: bool) -> None:
    """Fill in what nobody has set.

    Args:
        environment: `os.environ`, or that of a process to be started.
        exact: whether an agent is to get the same bits as one process that computes the whole team.
    """
    for name in _THREADS:
        environment.setdefault(name, "1")
    environment.setdefault("JAX_PLATFORMS", "cpu")
    keep_compilations(environment)
    flags = environment.get("XLA_FLAGS", "")
    for flag in (ONE_THREAD, *([ROUND_EACH] if exact and platform.machine() in ("x86_64", "AMD64") else [])):
        if flag.partition("=")[0] not in flags:
            flags = f"{flags} {flag}".strip()
    environment["XLA_FLAGS"] = flags


def prepare_own(*, exact: bool) -> None:
    """The same for this process."""
    prepare(os.environ, exact=exact)


def keep_compilations(environment: MutableMapping[str, str]) -> None:
    """Keep compiled programs between runs, in the user's own cache directory, unless somebody has said where."""
    if "JAX_COMPILATION_CACHE_DIR" not in environment:
        home = Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        environment["JAX_COMPILATION_CACHE_DIR"] = str(home / "consat" / "xla")
    if environment.get(_LOG_LEVEL, _OF_JAX) == _OF_JAX:
        environment[_LOG_LEVEL] = "3"  # XLA calls every program that it takes from there one of another machine, in 2 KiB on stderr
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
