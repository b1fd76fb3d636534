"""The paper from end to end, on a virtual robot."""

DEMO = "jaxid-demo/1"
"""Schema of the file `demo.json`."""
