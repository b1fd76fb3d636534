"""Logs, recordings, filters, observations (Eqs. 19, 25, 26)."""
