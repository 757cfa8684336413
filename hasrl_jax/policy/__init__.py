"""Policies that act: networks in NumPy, files, loading."""
