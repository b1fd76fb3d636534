"""The paper from end to end, on a virtual robot: a client of the public API."""
