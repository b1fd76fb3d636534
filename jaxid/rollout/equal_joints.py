"""Joints of one kind, like those of the legs: equal as far as the logs do not differ.

Their parameters are pulled towards the mean of their kind, as strongly as it lowers the
errors of motions that the fit has not seen.
"""

import dataclasses
import re
from collections.abc import Sequence

from jaxid.arrays import Indices
from jaxid.errors import InputError

from .joint_fits import JointFit, Pull

SIDES = (
    *("l", "r", "left", "right", "front", "rear", "hind", "back"),
    *("fl", "fr", "rl", "rr", "hl", "hr", "bl", "br"),
    *("lf", "rf", "lr", "lh", "rh", "lb", "rb"),
)
"""Words of joint names that tell a side, and not the kind of a joint."""
SCATTERS = (0.3, 0.1, 0.03, 0.01)
"""Relative scatters of equal joints' parameters that are tried."""
PULL_STEPS = 5
"""Steps of each fit with a pull."""


def joint_groups(
    names: Sequence[str], alike: Sequence[Sequence[str]] | None
) -> tuple[Indices, ...]:
    """Return the joints of each kind; a joint of no kind is alone.

    Args:
        names: Names of the joints.
        alike: Words of each kind, which the names of its joints contain, like
            `[["hip"], ["knee"]]`; kinds are names that differ only in a side, like
            `left_hip` and `right_hip`, if None.

    Raises:
        InputError: If words name no joint, or two kinds have a joint in common.
    """
    kinds = [_kind_of(name) or name for name in names]
    if alike is not None:
        kinds = list(names)
        for words in alike:
            members = [
                k for k, name in enumerate(names) if any(word in name for word in words)
            ]
            if not members:
                raise InputError(
                    f"`alike`: no joint has {' or '.join(words)} in its name; the "
                    f"joints are {', '.join(names)}."
                )
            for k in members:
                if kinds[k] != names[k]:
                    raise InputError(
                        f"`alike`: joint `{names[k]}` belongs to two kinds, but may "
                        "belong to only one."
                    )
                kinds[k] = f"kind {' '.join(words)}"
    return tuple(
        tuple(k for k, x in enumerate(kinds) if x == kind)
        for kind in dict.fromkeys(kinds)
    )


def _kind_of(name: str) -> str:
    """Return a joint's name without its side; empty if it names none."""
    words = re.split(r"[^a-z0-9]+", name.lower())
    kind = [word for word in words if word not in SIDES]
    return " ".join(kind) if len(kind) < len(words) else ""


def pull_equal_joints(fit: JointFit, groups: Sequence[Sequence[int]]) -> JointFit:
    """Return the fit with the pull of equal joints that held-out motions prefer."""
    equal_joints = [j for group in groups if len(group) > 1 for j in group]
    if not equal_joints:
        return fit
    best_fit = fit
    for scatter in SCATTERS:
        trial = dataclasses.replace(best_fit, pull=Pull(groups, scatter))
        # Means follow the parameters.
        trial = trial.improved(PULL_STEPS)
        scores = [x.held_out_scores[:, equal_joints].mean() for x in (trial, best_fit)]
        if scores[0] > scores[1]:
            break
        best_fit = trial
    return best_fit
