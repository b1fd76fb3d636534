"""Motions to excite and to verify with."""
