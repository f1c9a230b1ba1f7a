"""Numerical stability under stress: `python -m benchmarks.stress` writes the tables and plots of docs/stability.md."""
