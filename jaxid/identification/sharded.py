"""The pass over a long log on several devices at once: each takes a piece of the log in turn."""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxid.arrays import Array, double_precision
from jaxid.identification.kernel import Grams, Kernel, _padded
from jaxid.identification.streaming import Piece, Stream

_AXIS = "pieces"


def devices() -> list:
    """The CPU devices of this process: one, unless JAX was told to make more."""
    return jax.local_devices(backend="cpu")


class StreamOnDevices(Stream):
    """A log on its way through the compiled loop, as many pieces at once as there are devices.

    Products are added up in the order of the pieces, so the number of devices changes no digit
    but those that a compiler may change.
    """

    @functools.cached_property
    def _mesh(self) -> Mesh:
        return Mesh(np.array(devices()), (_AXIS,))

    def _runs(
        self, pieces: Sequence[Piece], mixing: Grams, most: int | None = None
    ) -> Iterator[tuple[Piece, Grams]]:
        if most is not None:
            pieces = [self._first(piece, most) for piece in pieces]
        size = self._mesh.devices.size
        groups = [pieces[k : k + size] for k in range(0, len(pieces), size)]
        with ThreadPoolExecutor(1) as reader:
            coming = [reader.submit(self._group, group) for group in groups[:1]]
            for group, following in itertools.zip_longest(groups, groups[1:]):
                arrays = coming.pop().result()
                if following is not None:
                    coming.append(reader.submit(self._group, following))
                yield from zip(group, self._grams_of(arrays, mixing), strict=False)

    def _group(self, pieces: Sequence[Piece]) -> list[np.ndarray]:
        """Motion, forces, weights and numbers of iterations of some pieces, a device first."""
        kernel: Kernel = self._kernel
        shape, size, n = kernel.shape, self._mesh.devices.size, self._mask.shape[1]
        length = shape.iterations * shape.samples
        arrays = [np.zeros((size, length, n)) for _ in range(4)]
        weights = np.zeros((size, shape.iterations * shape.rows, n), bool)
        counts = np.zeros((size, 1), np.int32)
        for k, piece in enumerate(pieces):
            motion, forces = self._read(piece.samples)
            for array, x in zip(arrays, (motion.q, motion.qd, motion.qdd, forces), strict=True):
                array[k] = _padded(np.asarray(x, np.float64), length)
            a, b = piece.rows
            weights[k, shape.delay : shape.delay + b - a] = self._mask[a:b]
            counts[k] = -(-(shape.delay + b - a) // shape.rows)
        return [*arrays, weights, counts]

    def _grams_of(self, arrays: list[np.ndarray], mixing: Grams) -> list[Grams]:
        run = _on_devices(self._kernel._run, self._mesh)
        with double_precision():
            found = run(*arrays[:5], mixing, self._kernel._matrices, arrays[5])
            found = [np.asarray(x) for x in found]
        return [[x[k] for x in found] for k in range(self._mesh.devices.size)]


@functools.lru_cache(maxsize=16)
def _on_devices(run: Callable, mesh: Mesh) -> Callable:
    """The compiled loop for one piece on each device, compiled once for all."""
    own, same = PartitionSpec(_AXIS), PartitionSpec()

    def device(q, qd, qdd, forces, weights, mixing, matrices, count) -> list[Array]:
        arrays = (x[0] for x in (q, qd, qdd, forces, weights))
        return [x[None] for x in run(*arrays, mixing, matrices, count[0, 0])]

    return jax.jit(sharded(device, mesh, (own,) * 5 + (same, same, own), own))


def sharded(function: Callable, mesh: Mesh, arguments: tuple, results: PartitionSpec) -> Callable:
    """`shard_map` of the installed version, which does not follow what varies over the devices."""
    if hasattr(jax, "shard_map"):
        return jax.shard_map(
            function, mesh=mesh, in_specs=arguments, out_specs=results, check_vma=False
        )
    from jax.experimental.shard_map import shard_map

    return shard_map(function, mesh=mesh, in_specs=arguments, out_specs=results, check_rep=False)
