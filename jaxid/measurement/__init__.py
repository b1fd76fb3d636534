"""Measurement: logs, recordings, filters and observations."""
