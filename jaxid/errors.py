"""The error that every invalid input raises."""

import re

LONG_WORD = re.compile(r"[^\s`]{301,}")
"""Word that no sentence shows whole, such as a damaged name; no path is so long."""
MAX_WORD_PART = 60
"""Characters of such a word that are shown."""


class InputError(ValueError):
    """Invalid input of a user: a sentence that names the input, the rule, the cure.

    Names and cells of damaged files may hold anything: what cannot be printed is left
    out, and very long words are folded.
    """

    def __init__(self, sentence: str):
        printable_text = "".join(c if c.isprintable() else " " for c in sentence)
        super().__init__(LONG_WORD.sub(folded, printable_text))


def folded(match: re.Match[str]) -> str:
    """Return the beginning of a long word."""
    return f"{match[0][:MAX_WORD_PART]}…"
