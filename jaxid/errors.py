"""The error that every invalid input raises."""


class InputError(ValueError):
    """Invalid input of a user: a sentence that names the input, the rule, the cure."""
