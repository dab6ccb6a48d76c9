"""Shared utilities: type aliases, errors, progress, safe arithmetic, caches, the machine and workers."""
