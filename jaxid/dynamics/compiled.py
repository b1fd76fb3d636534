"""The scalar programs of a model: its readable definition, traced once for its robot.

Programs are kept for the models that were used last. A model whose geometry JAX is tracing has
none: its definition is used as it stands.
"""

from collections import OrderedDict
from collections.abc import Callable

import jax
import numpy as np

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.program import Program, evaluate, evaluate_packed, trace
from jaxid.types import AnyArray, Float

_KEPT = 64
_programs: OrderedDict[tuple, Program] = OrderedDict()


def regressor_program(model: Model) -> Program:
    r"""The regressor $\Theta$ as a program of $(q, \dot q, \ddot q)$ (Eqs. 16, 18)."""
    n = (model.robot.joints,)
    return _remember("regressor", model, lambda: trace(model.columns, n, n, n))


def evaluate_regressor(
    model: Model, motion: Motion
) -> Float[np.ndarray, "samples joints standard"]:
    r"""The regressor in NumPy, in float64 whatever JAX's precision, without compiling (Eq. 16)."""
    theta = evaluate(regressor_program(model), *_batch_last(motion))
    return np.moveaxis(theta, -1, 0)


def evaluate_rows(
    model: Model, motion: Motion
) -> list[tuple[tuple[int, ...], Float[np.ndarray, "samples columns"]]]:
    """For each joint the columns that can act on it, and its row of the regressor there.

    The other columns are zero for every motion: a joint feels only the bodies beyond it.
    """
    program = regressor_program(model)
    samples = motion.q.shape[0]
    packed = evaluate_packed(program, *_batch_last(motion))
    acting = structure(model)
    rows = []
    for joint in range(model.robot.joints):
        entries = packed[joint * model.size : (joint + 1) * model.size]
        columns = tuple(int(k) for k in np.flatnonzero(acting[joint]))
        row = np.empty((samples, len(columns)), order="F")
        for place, k in enumerate(columns):
            row[:, place] = entries[k]
        rows.append((columns, row))
    return rows


def evaluate_forces(
    model: Model, p: Float[AnyArray, " standard"], motion: Motion
) -> Float[np.ndarray, "samples joints"]:
    r"""The generalized forces $\Theta p$ [N m or N] in NumPy, without compiling (Eq. 16)."""
    n = (model.robot.joints,)
    program = _remember("forces", model, lambda: trace(model.forces, (model.size,), n, n, n))
    return evaluate(program, np.asarray(p, np.float64), *_batch_last(motion)).T


def evaluate_tool_forces(model: Model, motion: Motion) -> Float[np.ndarray, "samples joints"]:
    """What the known tool adds to the measured forces [N m or N], in NumPy."""
    if model.robot.tool is None:
        return np.zeros(motion.q.shape)
    n = (model.robot.joints,)
    program = _remember("tool", model, lambda: trace(model.known_forces, n, n, n))
    return evaluate(program, *_batch_last(motion)).T


def evaluate_mass_matrix(
    model: Model, p: Float[AnyArray, " standard"], q: Float[AnyArray, "samples joints"]
) -> Float[np.ndarray, "samples joints joints"]:
    """The mass matrix in NumPy, without compiling (Eq. 38)."""
    n = (model.robot.joints,)
    program = _remember("mass matrix", model, lambda: trace(model.inertia, (model.size,), n))
    M = evaluate(program, np.asarray(p, np.float64), np.asarray(q, np.float64).T)
    return np.moveaxis(M, -1, 0)


def structure(model: Model) -> np.ndarray:
    """Which column can act on which joint: False where the regressor is zero for every motion."""
    return np.asarray(regressor_program(model).nonzeros)


def _batch_last(motion: Motion) -> list[np.ndarray]:
    return [np.asarray(x, np.float64).T for x in (motion.q, motion.qd, motion.qdd)]


def _remember(kind: str, model: Model, make: Callable[[], Program]) -> Program:
    key = (kind, *_content(model))
    program = _programs.get(key)
    if program is None:
        program = _programs[key] = make()
        while len(_programs) > _KEPT:
            _programs.popitem(last=False)
    _programs.move_to_end(key)
    return program


def _content(model: Model) -> tuple:
    """What a model is, by value: two equal models share their programs."""
    leaves, structure = jax.tree.flatten(model)
    return structure, tuple(_value(x) for x in leaves)


def _value(leaf: AnyArray | float) -> tuple:
    array = np.asarray(leaf)
    return array.shape, array.dtype.str, array.tobytes()
