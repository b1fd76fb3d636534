"""Physical consistency: parameters that belong to bodies which could exist."""
