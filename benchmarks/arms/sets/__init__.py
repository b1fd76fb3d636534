"""Robots of the benchmark: one function each."""
