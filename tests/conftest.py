import jax
from hypothesis import settings

# Strict: float64 unless a test says float32, and no silent promotion or broadcasting of ranks.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The same examples each time: a change should fail for what it changed.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")
