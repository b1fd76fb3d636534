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

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import acting_columns
from jaxid.dynamics.joint_rows import JointRows
from jaxid.dynamics.motion import Motion
from jaxid.identification.factors import Blocks, Factors, JointFactor, factorise
from jaxid.measurement.observations import Observations
from jaxid.types import AnyArray, Array, Float, require_float64

AT_ONCE = 8192
"""Samples of a device whose columns are held at once."""
PATIENCE = 600.0
"""Seconds that a process waits for the others."""
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
        ValueError: If shapes do not fit.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("factors on several devices")
    if mesh is None:
        mesh = Mesh(np.array(jax.local_devices()), (_AXIS,))
    if len(mesh.axis_names) != 1:
        raise ValueError(f"`mesh` must have one axis, but has {mesh.axis_names}.")
    n = base.model.robot.joints
    if motion.q.shape != forces.shape or forces.shape[-1] != n:
        raise ValueError(
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

        # Zeros made from the samples vary over the devices as the factors do.
        zero = q[0, 0, 0, 0] * 0.0
        start = [jnp.zeros((len(own) + 1, len(own) + 1), q.dtype) + zero for own in program.columns]
        found, _ = jax.lax.scan(add, start, tuple(x[0] for x in (q, qd, qdd, forces, counted)))
        return [R[None] for R in found]

    return jax.jit(_sharded(device, mesh, spec))


def _sharded(function: Callable, mesh: Mesh, spec: PartitionSpec) -> Callable:
    if hasattr(jax, "shard_map"):
        return jax.shard_map(function, mesh=mesh, in_specs=(spec,) * 5, out_specs=spec)
    from jax.experimental.shard_map import shard_map

    return shard_map(function, mesh=mesh, in_specs=(spec,) * 5, out_specs=spec)


def factorise_across_processes(
    base: BaseParameters,
    recordings: Sequence[Observations],
    blocks: int = 10,
    patience: float = PATIENCE,
) -> Blocks:
    """Reduces this process's recordings, and joins the factors of all processes.

    Call it in every process after `jax.distributed.initialize`; in a program without it, it is
    `factorise`. Every process gets the same blocks, in the order of the processes: `fit_blocks`
    gives the same fit everywhere.

    Args:
        base: The base parameters, the same in all processes.
        recordings: Of this process alone; none is allowed.
        blocks: Number of blocks of time of each recording.
        patience: Time to wait for the other processes [s].

    Raises:
        RuntimeError: If another process is lost during the exchange.
        TimeoutError: If another process does not arrive in time: it died, or reads for longer.
        ValueError: If the processes' base parameters differ.
    """
    require_float64("factors across processes")
    own = factorise(base, recordings, blocks) if recordings else Blocks(())
    if jax.process_count() == 1:
        return own
    _wait(patience)
    packed = _packed(own, base)
    heads = _gathered(np.array([len(packed), zlib.crc32(repr(base.indices).encode())]))
    if (heads[:, 1] != heads[0, 1]).any():
        raise ValueError(
            "`base` differs between the processes: make it from the same robot, terms and version."
        )
    most = int(heads[:, 0].max())
    padded = np.zeros((most, packed.shape[1]))
    padded[: len(packed)] = packed
    everyone = _gathered(padded)
    parts = [
        _unpacked(row, base)
        for rows, count in zip(everyone, heads[:, 0], strict=True)
        for row in rows[: int(count)]
    ]
    return Blocks(tuple(parts))


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
        raise TimeoutError(
            f"process {jax.process_index()} of {jax.process_count()} waited for the others' "
            f"factors, but not all came within {patience:g} s: look for the first error in the "
            f"others' logs, or raise `patience`. ({str(error).splitlines()[0]})"
        ) from error


def _gathered(x: np.ndarray) -> np.ndarray:
    """The arrays of all processes, one behind the other."""
    try:
        return np.asarray(multihost_utils.process_allgather(x))
    except jax.errors.JaxRuntimeError as error:
        raise RuntimeError(
            f"process {jax.process_index()} lost another one while factors were exchanged: look "
            f"for the first error in the others' logs. ({str(error).splitlines()[0]})"
        ) from error


def _packed(blocks: Blocks, base: BaseParameters) -> Float[np.ndarray, "blocks numbers"]:
    """One row of numbers for each block, of a length that all processes know."""
    rows = []
    for part in blocks.parts:
        numbers = []
        for joint in part.joints:
            width = len(joint.columns) + 1
            R = np.zeros((width, width))
            R[: len(joint.R)] = joint.R
            numbers += [[joint.rows], R.ravel()]
        rows.append(np.concatenate(numbers))
    size = sum((len(own) + 1) ** 2 + 1 for own in acting_columns(base))
    return np.array(rows).reshape(-1, size)


def _unpacked(row: Float[np.ndarray, " numbers"], base: BaseParameters) -> Factors:
    joints, start = [], 0
    for own in acting_columns(base):
        width = len(own) + 1
        stop = start + 1 + width**2
        R = row[start + 1 : stop].reshape(width, width)
        joints.append(JointFactor(own, R, int(row[start])))
        start = stop
    return Factors(tuple(joints), base.size)
