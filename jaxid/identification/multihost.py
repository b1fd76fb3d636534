"""Data sets that several processes read: distribution of files, and joining of factors.

Processes, on one host or many, read recordings of their own and exchange only factors:
some tens of kilobytes for each block of time. Factors are joined in a fixed order, so
that every process gets the same answer. The cores of one process need no function:
`identify` uses all of them.
"""

import itertools
import json
import zlib
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxid.arrays import require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.io import from_json, to_json
from jaxid.measurement.observations import Observations, Progress

from .factors import Blocks
from .problem import RegressionProblem

_calls = itertools.count()


def shards(folder: str | Path) -> tuple[Path, ...]:
    """Return the Parquet files of a folder that this process reads; all in a single process.

    Large files are assigned first, each to the process with the fewest bytes so far:
    all processes come to the same assignment without exchange. Open each file with
    `scan_log`.

    Args:
        folder: Folder of the data set, which all processes see.

    Raises:
        InputError: If there is no such file.
    """
    files = list(Path(folder).glob("*.parquet"))
    if not files:
        raise InputError(
            f"`{folder}` holds no file `*.parquet`: check the folder of the data set."
        )
    sizes, own = [0] * jax.process_count(), []
    for path in sorted(files, key=lambda p: (-p.stat().st_size, p)):
        process = sizes.index(min(sizes))
        sizes[process] += path.stat().st_size
        if process == jax.process_index():
            own.append(path)
    return tuple(sorted(own))


def factorise_across_processes(
    base: BaseParameters,
    recordings: Sequence[Observations],
    patience: float = 600.0,
    progress: Progress | None = None,
) -> RegressionProblem:
    """Return the regression problem of the recordings of all processes: their joined factors.

    Call it in every process after `jax.distributed.initialize`. Every process gets the
    same blocks, in the order of the processes: `identify` gives the same fit
    everywhere. Of more than 64 blocks, those of a process are joined with their
    neighbours in time.

    Args:
        base: The base parameters, the same in all processes.
        recordings: Recordings of this process alone, or none. `shards` distributes
            files.
        patience: Time to wait for the other processes [s].
        progress: Callback, called with the completed fraction (0 to 1) of a pass over
            long logs.

    Raises:
        RuntimeError: If another process is lost, or JAX's 64-bit mode is off.
        TimeoutError: If another process does not arrive in time: it died, or still
            reads.
        InputError: If the processes' base parameters differ.
    """
    require_float64("factors across processes")
    own, processes = Blocks(()), jax.process_count()
    if recordings:
        own = RegressionProblem(base, recordings, progress).blocks
    if processes == 1:
        return RegressionProblem(base, blocks=own, names=[o.name for o in recordings])
    # What must be the same in all processes for their factors to fit together.
    names = base.model.robot.joint_names, base.model.parameter_names
    content = repr((names, base.indices, np.round(base.kappa, 9).tolist())).encode()
    try:
        _wait(patience)
        own = own.condense(max(1, 64 // processes))
        # JSON is exact, and reading it runs no code.
        packed = np.frombuffer(json.dumps(to_json(own)).encode(), np.uint8)
        head = np.array([zlib.crc32(content), len(packed)])
        heads = multihost_utils.process_allgather(head)
        if (heads[:, 0] != heads[0, 0]).any():
            raise InputError(
                "`base` differs between the processes: use one robot and version."
            )
        filled = np.pad(packed, (0, heads[:, 1].max() - len(packed)))
        gathered = np.asarray(multihost_utils.process_allgather(filled))
        parts = []
        for x, length in zip(gathered, heads[:, 1], strict=True):
            document = json.loads(x[:length].tobytes())
            parts += from_json(document, Blocks).parts
        return RegressionProblem(base, blocks=Blocks(tuple(parts)))
    except jax.errors.JaxRuntimeError as error:
        raise RuntimeError(
            f"process {jax.process_index()} lost another one: look for the first "
            "error in the "
            f"others' logs. ({str(error).splitlines()[0]})"
        ) from error


def _wait(patience: float) -> None:
    """Let all processes arrive before any exchanges data, which has a short time limit."""
    from jax._src import distributed

    client = distributed.global_state.client
    if client is None:
        raise RuntimeError(
            "call `jax.distributed.initialize` first: there is no coordinator."
        )
    try:
        client.wait_at_barrier(f"jaxid_factors_{next(_calls)}", int(1000 * patience))
    except jax.errors.JaxRuntimeError as error:
        if "DEADLINE_EXCEEDED" not in str(error):
            raise
        raise TimeoutError(
            f"process {jax.process_index()} of {jax.process_count()} waited for the "
            "others' "
            f"factors, but not all came within {patience:g} s: look for the first "
            "error in the "
            f"others' logs, or raise `patience`. ({str(error).splitlines()[0]})"
        ) from error
