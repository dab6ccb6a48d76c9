"""The commands, one file each; `gs_jax.__main__` lists them."""
