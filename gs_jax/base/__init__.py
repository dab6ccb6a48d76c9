"""Shared utilities: errors, progress, safe arithmetic, caches, the machine and workers."""
