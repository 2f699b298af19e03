"""Experiments on the public API of kcgs, one module per question: `python -m benchmarks NAME -o DIR`."""
