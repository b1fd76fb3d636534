"""What is linear in the unknowns: terms, models, base parameters."""
