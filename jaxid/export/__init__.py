"""Hands an identified model over: C for controllers, files for simulators, vectors for tools."""
