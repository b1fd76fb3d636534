"""Methods of the benchmark: one function each."""
