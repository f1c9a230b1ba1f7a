"""Benchmarks: what is fast, and how it is known."""
