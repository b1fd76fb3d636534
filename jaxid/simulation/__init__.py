"""A virtual robot to experiment on."""
