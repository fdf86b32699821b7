"""Environment variables of an agent's process, set before JAX starts: one thread, and a cache of compiled programs."""

from __future__ import annotations

import os
import platform
from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_LOG_LEVEL, _OF_JAX = "TF_CPP_MIN_LOG_LEVEL", "1"
"""XLA's log level, and the default that JAX sets for itself, which subprocesses inherit."""
ONE_THREAD: Final = "--xla_cpu_multi_thread_eigen=false"
ROUND_EACH: Final = "--xla_cpu_max_isa=AVX"
"""Disables fused multiply-add, so each product is rounded. The bits of a result then do not depend on how XLA fuses operations."""


def prepare(environment: MutableMapping[str, str], *, exact: bool) -> None:
    """Set the variables that are not set yet.

    Args:
        environment: `os.environ`, or the environment of a process to be started.
        exact: whether results must be bit-identical to those of one process that computes the whole team.
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
    """As `prepare`, for the environment of this process."""
    prepare(os.environ, exact=exact)


def keep_compilations(environment: MutableMapping[str, str]) -> None:
    """Enable JAX's cache of compiled programs, in the user's cache directory unless another directory is set. Must be called before JAX
    starts."""
    if "JAX_COMPILATION_CACHE_DIR" not in environment:
        home = Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        environment["JAX_COMPILATION_CACHE_DIR"] = str(home / "consat" / "xla")
    if environment.get(_LOG_LEVEL, _OF_JAX) == _OF_JAX:
        environment[_LOG_LEVEL] = "3"  # for each cached program, XLA would log a false warning of 2 KiB about another machine
    environment.setdefault("EQX_ON_ERROR", "nan")  # the error callback of Equinox prevents caching; results carry their own status
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
