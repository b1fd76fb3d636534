"""Data that two runs share: together they would count double, and deviations would be wrong."""

import itertools
from collections.abc import Sequence

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.factors import Blocks, Factors

SAME = 1e-9
"""Relative difference up to which the norms of two blocks are those of the same data."""
CHANCE = 2
"""Blocks that must agree: one alone may be a robot that stands still in both."""


def share_data(first: Blocks, second: Blocks) -> bool:
    """Whether two sets of factors were made of the same rows, at least in part.

    Names do not tell: different logs may have the same, and one log several. Norms of the columns
    and forces do, whatever the weights of the joints.

    Args:
        first: Factors of some rows, by blocks of time.
        second: Factors of other logs.
    """
    ours, theirs = _norms(first), _norms(second)
    found = 0
    for rows in ours.keys() & theirs.keys():
        a, b = np.array(ours[rows]), np.array(theirs[rows])
        if a.shape[1:] == b.shape[1:]:
            apart = np.abs(a[:, None] - b[None]).max(axis=-1)
            found += int((apart <= SAME).any(axis=1).sum())
    return found >= max(1, min(CHANCE, _count(ours), _count(theirs)))


def refuse_shared(runs: Sequence[tuple[str, Blocks]]) -> None:
    """Refuses runs that have seen the same data.

    Args:
        runs: Their names and factors.

    Raises:
        InputError: If two have.
    """
    for (one, ours), (other, theirs) in itertools.combinations(runs, 2):
        if share_data(ours, theirs):
            which = f"runs `{one}` and `{other}`" if one != other else f"two runs `{one}`"
            raise InputError(
                f"the {which} have seen the same data, which would count twice: give every log "
                "once, as itself or by the report that was made of it."
            )


def _norms(blocks: Blocks) -> dict[tuple[int, ...], list[np.ndarray]]:
    """By numbers of rows: the norms of each block, as shares of the largest of their joint."""
    found: dict[tuple[int, ...], list[np.ndarray]] = {}
    for part in blocks.parts:
        if part.rows.any():
            found.setdefault(tuple(part.rows.tolist()), []).append(_shares(part))
    return found


def _shares(part: Factors) -> np.ndarray:
    norms = [np.linalg.norm(np.asarray(joint.R), axis=0) for joint in part.joints]
    return np.concatenate([own / max(own.max(initial=0.0), 1e-300) for own in norms])


def _count(norms: dict[tuple[int, ...], list[np.ndarray]]) -> int:
    return sum(map(len, norms.values()))
