"""Export of an identified model: C for controllers, files for simulators, vectors for tools."""
