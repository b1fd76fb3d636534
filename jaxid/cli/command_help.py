"""Help of the commands: names of arguments for people, and the exit codes."""

from typing import Any

from typer.core import TyperArgument, TyperCommand

UNUSABLE_CODE = 3
"""Exit code for a verdict against the use of a result, or recording of a motion."""
EXIT_CODES = (
    "Exit codes: 0 done; 2 wrong input, nothing was written; 3 done, but the verdict "
    "is ✗: do not use the result; 130 or 143 stopped by Ctrl-C or SIGTERM."
)


class Command(TyperCommand):
    """Command whose help and usage show arguments without Python's types and braces."""

    def get_params(self, ctx: Any) -> list:
        """Return arguments and options; only options name the type of their value."""
        parameters = super().get_params(ctx)
        for parameter in parameters:
            if isinstance(parameter, TyperArgument):
                parameter.display_type_rich = lambda ctx: None
        return parameters

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words of the usage line."""
        pieces = super().collect_usage_pieces(ctx)
        return [piece.replace("{", "").replace("}", "") for piece in pieces]
