"""Experiments with public names of kcgs, a module for each question: `python -m benchmarks NAME -o DIR`."""
