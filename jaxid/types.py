"""Shape vocabulary: the axes' names that annotations use, and the aliases that carry them.

Axes: `joints` (= bodies), `standard` (columns of the full regressor), `base` (columns of the base
regressor), `samples` (rows of a log), `rows` (what is left of them after filtering), `batch`.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import jax
import numpy as np
from jaxtyping import Array as Array
from jaxtyping import Bool as Bool
from jaxtyping import Float as Float
from jaxtyping import Int as Int
from jaxtyping import PRNGKeyArray as PRNGKeyArray

AnyArray = jax.Array | np.ndarray
"""A JAX array, or a NumPy array: what stays in NumPy stays a constant when JAX traces."""

# NumPy's own `ArrayLike` turns tuples away when types are checked at run time.
Numbers = AnyArray | Sequence[Any] | float | int
"""What users may pass where an array is meant: an array, nested lists or tuples, one number."""


def require_float64(what: str) -> None:
    """Refuses to go on in single precision.

    Args:
        what: The task that needs double precision, as it reads in a sentence.

    Raises:
        RuntimeError: If JAX's 64-bit mode is off.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            f"{what} needs float64, but JAX runs in float32: call "
            '`jax.config.update("jax_enable_x64", True)` at the start of the program, '
            "or set the environment variable JAX_ENABLE_X64=1."
        )


def double_precision() -> AbstractContextManager:
    """Lets JAX compute in float64 within a `with`, whatever its setting is outside."""
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(True)
    from jax.experimental import enable_x64  # pyright: ignore[reportAttributeAccessIssue]

    return enable_x64(True)
