"""Motions that tell parameters apart: criteria, constraints, solvers, design (Eq. 36)."""
