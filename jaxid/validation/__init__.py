"""Validation: torque errors, checks of sensors, mistakes in the description, verdict."""
