"""Names that stay what they are in files, comments and terminals."""

import unicodedata

_BREAKING = ("Cc", "Zl", "Zp")
"""Categories of Unicode that end a line or steer a terminal."""


def control_characters(name: str) -> str:
    """The first character that ends lines or steers terminals, as `U+001B`; empty if none."""
    found = (c for c in name if unicodedata.category(c) in _BREAKING and c != "\t")
    return next((f"U+{ord(c):04X}" for c in found), "")


def cleaned(name: str) -> str:
    """A name with a space in the place of each control character."""
    return "".join(" " if unicodedata.category(c) in _BREAKING else c for c in name)
