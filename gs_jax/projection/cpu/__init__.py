"""Compiled kernels for processors (numba and LLVM); without numba, or without this folder, XLA does the same work."""
