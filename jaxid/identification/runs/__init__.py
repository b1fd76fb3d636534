"""Several runs of one robot: what has changed between them, and what they tell together."""
