"""Validation: torque errors, sensor checks, mistakes in the description, verdict."""
