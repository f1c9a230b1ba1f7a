"""Speed and accuracy in figures: `python -m benchmarks.bench` writes the tables and plots of docs/benchmarks.md."""
