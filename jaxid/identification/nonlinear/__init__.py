"""Friction laws whose shapes are identified too: separable least squares by variable projection."""
