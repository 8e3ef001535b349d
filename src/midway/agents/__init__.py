"""Algorithms as pure functions, one file each."""
