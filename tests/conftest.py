"""What holds for every test: strict numerics, a CPU, no windows, the same examples in every run."""

import os

# Before the first import of JAX and matplotlib, and in the environment, so that subprocesses have them too.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ["MPLBACKEND"] = "Agg"

import hypothesis
import jax

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Seeded, and without a deadline: the first example pays for the compilation. To hunt: --hypothesis-profile=hunt
hypothesis.settings.register_profile("seeded", derandomize=True, deadline=None, database=None)
hypothesis.settings.register_profile("hunt", max_examples=2000, deadline=None)
hypothesis.settings.load_profile("seeded")
