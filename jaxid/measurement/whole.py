"""Whole numbers, which Python's floating numbers may be as well."""

from collections.abc import Callable

from jaxid.errors import InputError


def whole(name: str) -> Callable[[float | int], int]:
    """A converter that takes whole numbers only.

    Args:
        name: What the number is called.
    """

    def convert(value: float | int) -> int:
        number = float(value)
        if not number.is_integer():
            raise InputError(f"`{name}` must be a whole number, but is {value:g}.")
        return int(value)

    return convert
