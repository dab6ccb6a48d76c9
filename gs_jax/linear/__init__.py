"""Linear maps and operators of arrays: derivatives, transposes and convolutions, without a microscope."""
