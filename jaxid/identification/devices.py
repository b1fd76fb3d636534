"""The same factors from several devices or several processes.

Devices of one process share the samples of an array; each makes the triangular factor of its own
rows. Processes, on one host or many, read recordings of their own and exchange only factors: some
tens of kilobytes for each block of time. Factors are joined in a fixed order, so that every process
holds the same answer.
"""

import functools
import itertools
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxid.arrays import AnyArray, Array, Float, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import acting_columns
from jaxid.dynamics.joint_rows import JointRows
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.factors import Blocks, Factors, JointFactor, condensed, factorise
from jaxid.identification.sharded import sharded
from jaxid.identification.streaming import Progress
from jaxid.measurement.observations import Observations

AT_ONCE = 8192
"""Samples of a device whose columns are held at once."""
PATIENCE = 600.0
"""Seconds that a process waits for the others."""
MOST = 64
"""Blocks of time that processes hand on at most."""
_AXIS = "samples"
_calls = itertools.count()


def factorise_on_devices(
    base: BaseParameters,
    motion: Motion,
    forces: Float[AnyArray, "samples joints"],
    mesh: Mesh | None = None,
) -> Blocks:
    """Reduces samples to the factors of their joints on all devices of this process (Eq. 26).

    Give the result to `fit_blocks`. Each device makes one block of time.

    Args:
        base: The base parameters.
        motion: At all samples, filtered before.
        forces: Generalized forces [N m or N], filtered like the motion's columns.
        mesh: Of one axis; all devices of this process if None.

    Raises:
        InputError: If shapes do not fit.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("factors on several devices")
    if mesh is None:
        mesh = Mesh(np.array(jax.local_devices()), (_AXIS,))
    if len(mesh.axis_names) != 1:
        raise InputError(f"`mesh` must have one axis, but has {mesh.axis_names}.")
    n = base.model.robot.joints
    if motion.q.shape != forces.shape or forces.shape[-1] != n:
        raise InputError(
            f"`motion` and `forces` must have the shape [samples, {n}], but have "
            f"{motion.q.shape} and {forces.shape}."
        )
    if base.model.robot.tool is not None:
        forces = forces - np.asarray(base.model.tool_forces(motion))
    devices, samples = mesh.devices.size, len(forces)
    share = -(-samples // devices)
    chunks = -(-share // AT_ONCE)
    length = -(-share // chunks)
    filled = devices * chunks * length
    # Samples that fill up the last device's share are taken off by rows of zeros.
    rows = _divided(np.ones((samples, 1)), filled, devices, chunks)
    arrays = [_divided(np.asarray(x), filled, devices, chunks) for x in jax.tree.leaves(motion)]
    arrays += [_divided(np.asarray(forces), filled, devices, chunks), rows]
    sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names[0]))
    placed = [jax.device_put(x, sharding) for x in arrays]
    program = JointRows.of_base(base)
    found = [np.asarray(R) for R in _reduced(program, mesh)(*placed)]
    counts = rows.sum(axis=(1, 2, 3)).astype(int)
    parts = [
        Factors(
            tuple(
                JointFactor(own, R[k], int(counts[k]))
                for own, R in zip(program.columns, found, strict=True)
            ),
            base.size,
        )
        for k in range(devices)
        if counts[k]
    ]
    return Blocks(tuple(parts))


def _divided(x: np.ndarray, filled: int, devices: int, chunks: int) -> np.ndarray:
    whole = np.concatenate([x, np.zeros((filled - len(x), x.shape[1]))])
    return whole.reshape((devices, chunks, -1, x.shape[1]))


@functools.lru_cache(maxsize=8)
def _reduced(program: JointRows, mesh: Mesh) -> Callable:
    """The compiled computation: every device reduces its own chunks one after the other."""
    spec = PartitionSpec(mesh.axis_names[0])

    def device(q: Array, qd: Array, qdd: Array, forces: Array, counted: Array) -> list[Array]:
        def add(factors, chunk):
            *motion, Q, kept = chunk
            columns = program(*(x.T for x in motion))
            new = []
            for R, A, f in zip(factors, columns, Q.T, strict=True):
                rows = jnp.concatenate([A.T, f[:, None]], axis=1) * kept
                new.append(jnp.linalg.qr(jnp.concatenate([R, rows]), mode="r"))
            return new, None

        start = [jnp.zeros((len(own) + 1, len(own) + 1), q.dtype) for own in program.columns]
        found, _ = jax.lax.scan(add, start, tuple(x[0] for x in (q, qd, qdd, forces, counted)))
        return [R[None] for R in found]

    return jax.jit(sharded(device, mesh, (spec,) * 5, spec))


def shards(folder: str | Path, pattern: str = "*.parquet") -> tuple[Path, ...]:
    """The files of a data set that this process reads; all of them in a single process.

    Large files are dealt first, each to the process with the fewest bytes so far: alike in all
    processes, without asking. Open each with `scan_log`.

    Args:
        folder: Of the data set, which all processes see.
        pattern: Of the files' names.

    Raises:
        InputError: If there is no such file.
    """
    files = sorted(p for p in Path(folder).glob(pattern) if p.is_file())
    if not files:
        raise InputError(f"`{folder}` holds no file `{pattern}`: check the folder of the data set.")
    bytes_ = [0] * jax.process_count()
    own = []
    for path in sorted(files, key=lambda p: (-p.stat().st_size, p)):
        process = bytes_.index(min(bytes_))
        bytes_[process] += path.stat().st_size
        if process == jax.process_index():
            own.append(path)
    return tuple(sorted(own))


def factorise_across_processes(
    base: BaseParameters,
    recordings: Sequence[Observations],
    blocks: int = 10,
    patience: float | int = PATIENCE,
    progress: Progress | None = None,
) -> Blocks:
    """Reduces this process's recordings, and joins the factors of all processes in a tree.

    Call it in every process after `jax.distributed.initialize`; in a program without it, it is
    `factorise`. Processes hand their blocks on in pairs, so that none ever holds more than `MOST`
    blocks; what is more is joined with its neighbour in time. Every process gets the same blocks,
    in the order of the processes: `fit_blocks` gives the same fit everywhere.

    Args:
        base: The base parameters, the same in all processes.
        recordings: Of this process alone; none is allowed. `shards` deals files out.
        blocks: Number of blocks of time of each recording.
        patience: Time to wait for the other processes [s].
        progress: Is told now and then which share of long logs is done, of 1.

    Raises:
        RuntimeError: If another process is lost, or JAX's 64-bit mode is off.
        TimeoutError: If another process does not arrive in time: it died, or reads for longer.
        InputError: If the processes' base parameters differ.
    """
    require_float64("factors across processes")
    own = factorise(base, recordings, blocks, progress) if recordings else Blocks(())
    if jax.process_count() == 1:
        return own
    try:
        _wait(patience)
        heads = multihost_utils.process_allgather(np.array([zlib.crc32(_content(base))]))
        if (heads != heads[0]).any():
            raise InputError(
                "`base` differs between the processes: make it from the same robot, terms and "
                "version."
            )
        return Blocks(tuple(_tree(own.parts, base)))
    except jax.errors.JaxRuntimeError as error:
        raise RuntimeError(
            f"process {jax.process_index()} lost another one: look for the first error in the "
            f"others' logs, and start all again. ({str(error).splitlines()[0]})"
        ) from error


def _content(base: BaseParameters) -> bytes:
    """What must be the same in all processes for their factors to fit together."""
    names = base.model.robot.joint_names, base.model.parameter_names
    return repr((names, base.indices, np.round(base.kappa, 9).tolist())).encode()


def _tree(parts: Sequence[Factors], base: BaseParameters) -> list[Factors]:
    """The blocks of all processes, gathered in pairs by the first one, and given to all."""
    count, number = jax.process_count(), jax.process_index()
    firsts = {d.process_index: d for d in reversed(jax.devices())}
    mesh = Mesh(np.array([firsts[k] for k in range(count)]), (_AXIS,))
    held = condensed(parts, MOST)
    step = 1
    while step < count:
        ways = tuple((k, k - step) for k in range(step, count, 2 * step))
        came = _unpacked(_sent(_packed(held, base), mesh, ways), base)
        held = condensed([*held, *came], MOST)
        step *= 2
    packed = _packed(held if number == 0 else (), base)
    return _unpacked(np.asarray(multihost_utils.broadcast_one_to_all(packed)), base)


def _sent(x: np.ndarray, mesh: Mesh, ways: tuple[tuple[int, int], ...]) -> np.ndarray:
    """What another process has sent here; zeros if none has."""
    own = jax.device_put(x[None], mesh.devices[jax.process_index()])
    sharding = NamedSharding(mesh, PartitionSpec(_AXIS))
    shape = (mesh.devices.size, *x.shape)
    everyone = jax.make_array_from_single_device_arrays(shape, sharding, [own])
    return np.asarray(_sending(mesh, ways)(everyone).addressable_data(0))[0]


def _sending(mesh: Mesh, ways: tuple[tuple[int, int], ...]) -> Callable:
    spec = PartitionSpec(_AXIS)
    return jax.jit(sharded(lambda x: jax.lax.ppermute(x, _AXIS, ways), mesh, (spec,), spec))


def _wait(patience: float) -> None:
    """Lets all processes arrive before any exchanges data, which has a short time limit."""
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


def _packed(parts: Sequence[Factors], base: BaseParameters) -> Float[np.ndarray, "most numbers"]:
    """One row of numbers for each block, behind a one; rows of zeros fill up."""
    size = sum((len(own) + 1) ** 2 + 1 for own in acting_columns(base))
    packed = np.zeros((MOST, 1 + size))
    for row, part in zip(packed, parts, strict=False):
        numbers = [[1.0]]
        for joint in part.joints:
            width = len(joint.columns) + 1
            R = np.zeros((width, width))
            R[: len(joint.R)] = joint.R
            numbers += [[joint.rows], R.ravel()]
        row[:] = np.concatenate(numbers)
    return packed


def _unpacked(packed: Float[np.ndarray, "most numbers"], base: BaseParameters) -> list[Factors]:
    found = []
    for row in packed[packed[:, 0] > 0]:
        joints, start = [], 1
        for own in acting_columns(base):
            width = len(own) + 1
            stop = start + 1 + width**2
            R = row[start + 1 : stop].reshape(width, width)
            joints.append(JointFactor(own, R, int(row[start])))
            start = stop
        found.append(Factors(tuple(joints), base.size))
    return found
