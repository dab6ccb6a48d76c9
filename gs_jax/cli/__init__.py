"""Commands of `gs-jax`; `gs_jax.__main__` lists the module of each."""
