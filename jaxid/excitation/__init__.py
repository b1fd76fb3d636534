"""Excitation: motions that determine the base parameters well; problem, solver, design (Eq. 36)."""
