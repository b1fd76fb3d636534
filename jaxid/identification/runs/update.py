"""A later run added to an earlier one without the earlier data; runs in files."""

import io
import json
import operator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.factors import Blocks, Factors, JointFactor
from jaxid.identification.runs.run import Run, require_same_base
from jaxid.identification.runs.tied import tied
from jaxid.io import read_arrays, write_bytes

SCHEMA = "jaxid-run/1"
ALIKE = 1e-6
"""Relative difference that two regroupings of one geometry may have."""


class _Head(NamedTuple):
    """What is no array in the file of a run."""

    schema: str
    name: str
    recordings: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    robot: str
    columns: list[tuple[int, ...]]
    rows: list[list[int]]

    @classmethod
    def of(cls, text: str) -> "_Head":
        raw = json.loads(text)
        columns = [tuple(map(operator.index, own)) for own in raw["columns"]]
        rows = [list(map(operator.index, own)) for own in raw["rows"]]
        return cls(
            schema=str(raw["schema"]),
            name=str(raw["name"]),
            recordings=tuple(map(str, raw["recordings"])),
            names=tuple(map(str, raw["names"])),
            units=tuple(map(str, raw["units"])),
            robot=str(raw["robot"]),
            columns=columns,
            rows=rows,
        )


def update(earlier: Run, later: Run, name: str | None = None) -> Run:
    """Adds a later run to an earlier one, as if both had been identified together.

    The estimates are those of the joint fit to rounding, and only factors are needed: the earlier
    run may come from a file. If the runs' weights differ, each keeps its own.

    Args:
        earlier: What was known.
        later: What was learned since then, of the robot in the same state.
        name: Of both together; their names in a row if None.

    Raises:
        InputError: If the runs have different base parameters, or have seen the same data.
    """
    runs = (earlier, later)
    require_same_base(runs)
    E = np.eye(earlier.base.size)
    found = tied(runs, (E, E))
    parts = (*earlier.blocks.parts, *later.weighted_like(earlier.weights).blocks.parts)
    return Run(
        base=earlier.base,
        blocks=Blocks(parts),
        weights=earlier.weights,
        parameters=found.parameters,
        covariance=found.covariance,
        freedom=found.freedom,
        name=", ".join(run.name for run in runs) if name is None else name,
        recordings=(*earlier.recordings, *later.recordings),
    )


def save_run(path: str | Path, run: Run) -> None:
    """Writes a run to a file (NPZ), whole or not at all; `load_run` reads it back exactly.

    Args:
        path: Of the file; one that is there is replaced.
        run: The run.

    Raises:
        InputError: If the file's place is no place for a file.
    """
    arrays: dict[str, Any] = {
        key: np.asarray(getattr(run, key))
        for key in ("weights", "parameters", "covariance", "freedom")
    }
    arrays["kappa"] = np.asarray(run.base.kappa)
    for b, part in enumerate(run.blocks.parts):
        for j, joint in enumerate(part.joints):
            arrays[f"R_{b}_{j}"] = np.asarray(joint.R)
    head = {
        "schema": SCHEMA,
        "name": run.name,
        "recordings": run.recordings,
        "names": run.base.names,
        "units": run.base.units,
        "robot": run.base.model.robot.name,
        "columns": [joint.columns for joint in run.blocks.parts[0].joints],
        "rows": [[joint.rows for joint in part.joints] for part in run.blocks.parts],
    }
    arrays["head"] = np.array(json.dumps(head))
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    path = Path(path)
    write_bytes(path, file.getvalue())


def load_run(path: str | Path, base: BaseParameters) -> Run:
    """Reads a run that `save_run` has written.

    Args:
        path: Of the file.
        base: The base parameters that it was made with: of the same robot and terms.

    Raises:
        InputError: If the file holds no run, or one of other base parameters.
    """
    try:
        arrays = read_arrays(path)
        head = _Head.of(str(arrays["head"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise _no_run(path) from error
    if head.schema != SCHEMA:
        raise _no_run(path)
    _require_same(path, head, arrays.get("kappa", np.zeros(0)), base)
    found = {key: _sound(path, arrays, key, shape) for key, shape in _shapes(base).items()}
    columns = head.columns
    if len(columns) != base.model.robot.joints or not all(
        0 <= k < base.size for own in columns for k in own
    ):
        raise InputError(
            f"`{path}` is damaged: `columns` are not those of its joints; identify again."
        )
    parts = []
    for b, rows in enumerate(head.rows):
        if len(rows) != len(columns) or min(rows, default=0) < 0:
            raise InputError(
                f"`{path}` is damaged: `rows[{b}]` are not its joints'; identify again."
            )
        joints = (
            JointFactor(own, _sound(path, arrays, f"R_{b}_{j}", (None, len(own) + 1)), count)
            for j, (own, count) in enumerate(zip(columns, rows, strict=True))
        )
        parts.append(Factors(tuple(joints), base.size))
    if not parts:
        raise InputError(f"`{path}` is damaged: it holds no rows; identify again.")
    return Run(
        base=base, blocks=Blocks(tuple(parts)), name=head.name, recordings=head.recordings, **found
    )


def _no_run(path: str | Path) -> InputError:
    return InputError(f"`{path}` must hold a run (`{SCHEMA}`), as `save_run` writes it.")


def _shapes(base: BaseParameters) -> dict[str, tuple[int, ...]]:
    n, size = base.model.robot.joints, base.size
    return {"weights": (n,), "parameters": (size,), "covariance": (size, size), "freedom": (size,)}


def _sound(
    path: str | Path, arrays: dict[str, np.ndarray], key: str, shape: tuple[int | None, ...]
) -> np.ndarray:
    """An array of the file, of the right shape and without what is no number."""
    array = arrays.get(key, np.zeros(0))
    wrong = array.dtype != np.float64 or array.ndim != len(shape)
    wrong = wrong or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
    if wrong or np.isnan(array).any():
        raise InputError(
            f"`{path}` is damaged: its array `{key}` is missing, or holds what is no number; "
            "identify again."
        )
    return array


def _require_same(path: str | Path, head: _Head, kappa: np.ndarray, base: BaseParameters):
    for key, there, own in (
        ("names", head.names, base.names),
        ("units", head.units, base.units),
    ):
        if there != own:
            pairs = zip(there, own, strict=False)
            first, here = next(((a, b) for a, b in pairs if a != b), ("more", "fewer"))
            raise InputError(
                f"`{path}` holds a run of other base parameters than `base`: {key} differ, "
                f"`{first}` there and `{here}` here; use the robot and the terms of the file."
            )
    if kappa.shape != base.kappa.shape or not np.allclose(kappa, base.kappa, ALIKE, ALIKE):
        raise InputError(
            f"`{path}` holds a run of `{head.robot}` with another geometry than that of `base`: "
            "lengths differ; use the robot of the file."
        )
