"""Powers of length in the units of parameters."""

_LENGTH_POWERS = {"1": 0, "rad": 0, "kg": 0, "m": 1, "s": 0, "N": 1, "J": 2, "W": 2}
_EXPONENTS = {"²": 2, "³": 3, "⁴": 4}


def length_power(unit: str) -> int:
    """Return the power of length in a unit: 2 in kg m² and N m; 0 if unknown."""
    total = 0
    numerator, *denominators = unit.split("/")
    for part, sign in ((numerator, 1), *((part, -1) for part in denominators)):
        for factor in part.replace("(", " ").replace(")", " ").split():
            symbol = factor.rstrip("".join(_EXPONENTS))
            if symbol not in _LENGTH_POWERS:
                return 0
            exponent = _EXPONENTS.get(factor[len(symbol) :], 1)
            total += sign * exponent * _LENGTH_POWERS[symbol]
    return total
