"""Data sets that several processes read: distribution of files, and joining of factors.

Processes, on one host or many, read recordings of their own and exchange only factors: some tens of
kilobytes for each block of time. Factors are joined in a fixed order, so that every process gets
the same answer. The devices of one process need no function of their own: `identify` uses all CPU
devices for long logs.
"""

import itertools
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxid.arrays import Float, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.compiled import shard_map
from jaxid.identification.factors import Blocks, Factors, JointFactor
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.observations import Observations, Progress

MOST = 64
"""Largest number of blocks of time that a process passes on."""
_calls = itertools.count()


def shards(folder: str | Path, pattern: str = "*.parquet") -> tuple[Path, ...]:
    """Return the files of a data set that this process reads; all of them in a single process.

    Large files are assigned first, each to the process with the fewest bytes so far: all processes
    come to the same assignment without exchange. Open each file with `scan_log`.

    Args:
        folder: Folder of the data set, which all processes see.
        pattern: Pattern of the file names.

    Raises:
        InputError: If there is no such file.
    """
    files = sorted(p for p in Path(folder).glob(pattern) if p.is_file())
    if not files:
        raise InputError(f"`{folder}` holds no file `{pattern}`: check the folder of the data set.")
    sizes = [0] * jax.process_count()
    own = []
    for path in sorted(files, key=lambda p: (-p.stat().st_size, p)):
        process = sizes.index(min(sizes))
        sizes[process] += path.stat().st_size
        if process == jax.process_index():
            own.append(path)
    return tuple(sorted(own))


def factorise_across_processes(
    base: BaseParameters,
    recordings: Sequence[Observations],
    divisions: int = 10,
    patience: float | int = 600.0,
    progress: Progress | None = None,
) -> RegressionProblem:
    """Return the regression problem of the recordings of all processes: their joined factors.

    Call it in every process after `jax.distributed.initialize`. Processes pass their blocks on in
    pairs, so that none ever holds more than 64; further blocks are joined with their neighbours in
    time. Every process gets the same blocks, in the order of the processes: `fit_problem` gives the
    same fit everywhere.

    Args:
        base: The base parameters, the same in all processes.
        recordings: Recordings of this process alone, or none. `shards` distributes files.
        divisions: Number of blocks of time of each recording.
        patience: Time to wait for the other processes [s].
        progress: Callback, called with the completed fraction (0 to 1) of a pass over long logs.

    Raises:
        RuntimeError: If another process is lost, or JAX's 64-bit mode is off.
        TimeoutError: If another process does not arrive in time: it died, or still reads.
        InputError: If the processes' base parameters differ.
    """
    require_float64("factors across processes")
    own = Blocks(())
    if recordings:
        own = RegressionProblem(base, recordings, progress, divisions=divisions).blocks
    if jax.process_count() == 1:
        return RegressionProblem(base, blocks=own, names=[o.name for o in recordings])
    try:
        _wait(patience)
        heads = multihost_utils.process_allgather(np.array([zlib.crc32(_content(base))]))
        if (heads != heads[0]).any():
            raise InputError(
                "`base` differs between the processes: make it from the same robot, terms and "
                "version."
            )
        return RegressionProblem(base, blocks=_join_in_a_tree(own, base))
    except jax.errors.JaxRuntimeError as error:
        raise RuntimeError(
            f"process {jax.process_index()} lost another one: look for the first error in the "
            f"others' logs, and start all again. ({str(error).splitlines()[0]})"
        ) from error


def _content(base: BaseParameters) -> bytes:
    """Return what must be the same in all processes for their factors to fit together."""
    names = base.model.robot.joint_names, base.model.parameter_names
    return repr((names, base.indices, np.round(base.kappa, 9).tolist())).encode()


def _join_in_a_tree(blocks: Blocks, base: BaseParameters) -> Blocks:
    """Return the blocks of all processes, gathered in pairs by the first one, and sent to all."""
    count, number = jax.process_count(), jax.process_index()
    firsts = {d.process_index: d for d in reversed(jax.devices())}
    mesh = Mesh(np.array([firsts[k] for k in range(count)]), ("processes",))
    blocks = blocks.condense(MOST)
    step = 1
    while step < count:
        routes = tuple((k, k - step) for k in range(step, count, 2 * step))
        received = _unpack(_exchange(_pack(blocks, base), mesh, routes), base)
        blocks = Blocks((*blocks.parts, *received.parts)).condense(MOST)
        step *= 2
    packed = _pack(blocks if number == 0 else Blocks(()), base)
    return _unpack(np.asarray(multihost_utils.broadcast_one_to_all(packed)), base)


def _exchange(x: np.ndarray, mesh: Mesh, routes: tuple[tuple[int, int], ...]) -> np.ndarray:
    """Return the array that another process has sent here; zeros if none has."""
    own = jax.device_put(x[None], mesh.devices[jax.process_index()])
    sharding = NamedSharding(mesh, PartitionSpec("processes"))
    shape = (mesh.devices.size, *x.shape)
    everyone = jax.make_array_from_single_device_arrays(shape, sharding, [own])
    return np.asarray(_permutation(mesh, routes)(everyone).addressable_data(0))[0]


def _permutation(mesh: Mesh, routes: tuple[tuple[int, int], ...]) -> Callable:
    spec = PartitionSpec("processes")
    send = shard_map(lambda x: jax.lax.ppermute(x, "processes", routes), mesh, (spec,), spec)
    return jax.jit(send)


def _wait(patience: float) -> None:
    """Let all processes arrive before any exchanges data, which has a short time limit."""
    from jax._src import distributed

    client = distributed.global_state.client
    if client is None:
        raise RuntimeError(
            "several processes, but no coordinator: call `jax.distributed.initialize` first."
        )
    try:
        client.wait_at_barrier(f"jaxid_factors_{next(_calls)}", int(1000 * patience))
    except jax.errors.JaxRuntimeError as error:
        if "DEADLINE_EXCEEDED" not in str(error):
            raise
        raise TimeoutError(
            f"process {jax.process_index()} of {jax.process_count()} waited for the others' "
            f"factors, but not all came within {patience:g} s: look for the first error in the "
            f"others' logs, or raise `patience`. ({str(error).splitlines()[0]})"
        ) from error


def _pack(blocks: Blocks, base: BaseParameters) -> Float[np.ndarray, "most numbers"]:
    """Return one row of numbers for each block, behind a one; rows of zeros fill up."""
    size = sum((len(own) + 1) ** 2 + 1 for own in base.acting_columns)
    packed = np.zeros((MOST, 1 + size))
    for row, part in zip(packed, blocks.parts, strict=False):
        numbers = [[1.0]]
        for joint in part.joints:
            width = len(joint.columns) + 1
            R = np.zeros((width, width))
            R[: len(joint.R)] = joint.R
            numbers += [[joint.rows], R.ravel()]
        row[:] = np.concatenate(numbers)
    return packed


def _unpack(packed: Float[np.ndarray, "most numbers"], base: BaseParameters) -> Blocks:
    parts = []
    for row in packed[packed[:, 0] > 0]:
        joints, start = [], 1
        for own in base.acting_columns:
            width = len(own) + 1
            stop = start + 1 + width**2
            R = row[start + 1 : stop].reshape(width, width)
            joints.append(JointFactor(own, R, int(row[start])))
            start = stop
        parts.append(Factors(tuple(joints), base.size))
    return Blocks(tuple(parts))
