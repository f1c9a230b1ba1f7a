"""Other libraries on the problems of this one: `python -m benchmarks.peers`."""
