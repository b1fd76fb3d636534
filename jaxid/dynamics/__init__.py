"""Dynamics linear in the unknowns: terms, models, base parameters."""
