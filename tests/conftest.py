"""What holds for every test: strict numerics, a CPU, no windows, the same examples in every run.

Compiled programs are kept where the command line keeps them, so that workers, the processes that tests start, and the next run share them.
"""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

# Before the first import of JAX and matplotlib, and in the environment, so that subprocesses have them too.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ["MPLBACKEND"] = "Agg"
os.environ.setdefault("EQX_ON_ERROR", "nan")  # its error callback would forbid keeping them
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path.home() / ".cache" / "consat" / "xla"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("MYPY_CACHE_DIR", str(Path.home() / ".cache" / "consat" / "mypy"))  # two tests check the same libraries

import hypothesis
import jax
import pytest

gc.set_threshold(50_000, 20, 100)  # JAX traces make many objects and few cycles: an eighth of the suite would be spent looking for them
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Seeded, and without a deadline: the first example pays for the compilation. To hunt: --hypothesis-profile=hunt
hypothesis.settings.register_profile("seeded", derandomize=True, deadline=None, database=None)
hypothesis.settings.register_profile("hunt", max_examples=2000, deadline=None)
hypothesis.settings.load_profile("seeded")

ROOM = 3 * 2**30
"""Memory that a worker may hold between two modules, bytes."""


@pytest.fixture(autouse=True, scope="module")
def room() -> Iterator[None]:
    """A worker that has compiled hundreds of programs holds gigabytes, and has crashed: beyond `ROOM` it drops them."""
    yield
    pages = Path("/proc/self/statm")
    if pages.exists() and int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") > ROOM:
        jax.clear_caches()
        gc.collect()
