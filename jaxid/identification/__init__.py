"""Estimation: factors, weights, estimators, and what the data do not determine."""
