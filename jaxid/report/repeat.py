"""How a result can be had again: versions, the command, and the file that it was asked with."""

from collections.abc import Mapping
from typing import Any

from jaxid.report.blocks import AbstractBlock, Code, Facts, Folded
from jaxid.report.content import versions


def repeat(settings: Mapping[str, Any]) -> tuple[AbstractBlock, ...]:
    """The last part of a page.

    Args:
        settings: How the result came about, as far as it is known: `facts` (pairs of a word and a
            text), `command` and `experiment_text`.
    """
    blocks: list[AbstractBlock] = [Facts((*settings.get("facts", ()), *versions().items()))]
    command = settings.get("command")
    if command:
        blocks.append(Code(str(command)))
    text = settings.get("experiment_text")
    if text:
        blocks.append(Folded("The experiment file", (Code(str(text)),)))
    return tuple(blocks)
