"""Files of arrays, which have names like `q` and columns like `q[0]`."""

import abc
import functools
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format

from jaxid.io import import_extra

from ..log_columns import has_column, selected_names
from .log_file import AbstractLogFile
from .log_table import LogTable, readable, refuse_inflation

MAX_COLUMNS = 1000
"""Columns of the widest array that is a log."""
COMPRESSED_ELEMENT = 15
"""Type of the variables of a MAT file that are compressed."""
PIECE_SIZE = 2**20
"""Bytes that are decompressed at once."""
MAX_COUNTED_SIZE = 2**30
"""Size up to which that of a compressed variable is counted [bytes]."""

Shape = tuple[int, ...]
"""Shape of an array."""
Arrays = dict[str, np.ndarray]
"""Arrays by name."""


class AbstractArrayFile(AbstractLogFile):
    """File of arrays (samples, or samples x joints); columns have names like `q[0]`."""

    @abc.abstractmethod
    def load(self) -> Arrays:
        """Return the arrays of the file by their names."""

    @functools.cached_property
    def arrays(self) -> Arrays:
        """Arrays of the file, and the columns of matrices."""
        arrays = self.load()
        columns = {}
        for name, array in arrays.items():
            # A matrix with more columns than rows is no log.
            max_columns = min(len(array), MAX_COLUMNS)
            if array.ndim == 2 and array.shape[1] <= max_columns:
                for k in range(array.shape[1]):
                    columns[f"{name}[{k}]"] = array[:, k]
        return arrays | columns

    @property
    def names(self):  # noqa: D102
        return tuple(self.arrays)

    def table(self, channels, on_disk, bad_rows):  # noqa: D102
        return LogTable(self.path.name, self.arrays, channels, bad_rows=bad_rows)

    def is_selected(self, name: str) -> bool:
        """Return whether columns of an array, or of a structure, will be read."""
        return any(
            column.startswith(f"{name}.")
            or has_column([name], column.partition("[")[0])
            for column in selected_names(self.selections)
        )

    def read_selected(
        self, shapes: Mapping[str, Shape], read: Callable[[str], Any]
    ) -> Arrays:
        """Read the selected arrays; others of these shapes hold NaN, without memory."""
        arrays = {
            name: np.broadcast_to(np.nan, shape) for name, shape in shapes.items()
        }
        names = [name for name in arrays if self.is_selected(name)]
        refuse_inflation(self.path, {name: arrays[name].nbytes for name in names})
        return arrays | {name: read(name) for name in names}


class NpzFile(AbstractArrayFile):
    """NPZ file of NumPy."""

    def load(self):  # noqa: D102
        # Objects, which could run code, are rejected.
        kind = "NPZ file of plain arrays (`numpy.savez`, without objects)"
        with readable(self.path.name, kind), zipfile.ZipFile(self.path) as archive:
            # A member that NumPy did not write is left out.
            members = [name for name in archive.namelist() if name.endswith(".npy")]
            shapes = {}
            for member in members:
                with archive.open(member) as file:
                    shapes[member.removesuffix(".npy")] = npy_shape(file)

            def read(name: str) -> np.ndarray:
                with archive.open(f"{name}.npy") as file:
                    return npy_format.read_array(file)

            return _named_arrays(self.read_selected(shapes, read))


def npy_shape(file: Any) -> Shape:
    """Return the shape of an array in a file of NumPy."""
    is_first_version = npy_format.read_magic(file) == (1, 0)
    read_header = npy_format.read_array_header_2_0
    if is_first_version:
        read_header = npy_format.read_array_header_1_0
    shape, _, _ = read_header(file)
    return shape


class MatFile(AbstractArrayFile):
    """MAT file of MATLAB, of any version."""

    def load(self):  # noqa: D102
        with self.path.open("rb") as file:
            head = file.read(516)
        if b"\x89HDF" in head:
            # Version 7.3 is HDF5, in which the arrays are transposed.
            arrays = read_hdf5(self)
            return _named_arrays({name: array.T for name, array in arrays.items()})
        with readable(self.path.name, "MAT file"):
            return self._variables()

    def _variables(self) -> Arrays:
        """Return the variables of a file before version 7.3."""
        from scipy.io import loadmat, whosmat
        from scipy.io.matlab import matfile_version

        variables = whosmat(self.path)
        shapes = {name: shape for name, shape, _ in variables}
        structures = [name for name, _, kind in variables if kind == "struct"]
        sizes = dict.fromkeys(shapes, 0)
        if matfile_version(self.path) == (1, 0):
            sizes = dict(zip(shapes, variable_sizes(self.path), strict=False))
        # Columns of structures have names only if they are read.
        needed_sizes = {
            name: size
            for name, size in sizes.items()
            if name in structures or self.is_selected(name)
        }
        refuse_inflation(self.path, needed_sizes)
        content = loadmat(
            self.path, variable_names=[*needed_sizes], simplify_cells=True
        )
        arrays = self.read_selected(shapes, content.__getitem__)
        return _named_arrays(arrays | {name: content[name] for name in structures})


def variable_sizes(path: Path) -> list[int]:
    """Return the sizes of the variables of a MAT file, decompressed [bytes]."""
    sizes = []
    with path.open("rb") as file:
        # The header ends with the order of bytes.
        order = "<" if file.read(128)[-2:] == b"IM" else ">"
        while tag := file.read(8):
            kind, size = struct.unpack(f"{order}II", tag)
            if kind == COMPRESSED_ELEMENT:
                size = decompressed_size(file.read(size))
            else:
                file.seek(size, 1)
            sizes.append(size)
    return sizes


def decompressed_size(data: bytes) -> int:
    """Return the size of compressed data [bytes], which is not counted to its end."""
    inflater = zlib.decompressobj()
    size = 0
    while data and size < MAX_COUNTED_SIZE:
        size += len(inflater.decompress(data, PIECE_SIZE))
        data = inflater.unconsumed_tail
    return size


class Hdf5File(AbstractArrayFile):
    """HDF5 file; arrays in a group are named like `log.q`."""

    def load(self):  # noqa: D102
        return read_hdf5(self)


def read_hdf5(log: AbstractArrayFile) -> Arrays:
    """Read the selected arrays of an HDF5 file, without images.

    Those in a group are named like `log.q`.
    """
    h5py = import_extra("h5py", "logs", f"`{log.path.name}` is read by")
    with readable(log.path.name, "HDF5 file"), h5py.File(log.path, "r") as file:
        datasets = _named_arrays(file)
        shapes = {name: dataset.shape for name, dataset in datasets.items()}
        return log.read_selected(shapes, lambda name: datasets[name][()])


def _named_arrays(content: Mapping[str, Any], prefix: str = "") -> Arrays:
    """Return arrays by name; those in a structure are named like `log.q`."""
    arrays: Arrays = {}
    for key, value in content.items():
        name = prefix + key
        if isinstance(value, Mapping):
            arrays |= _named_arrays(value, f"{name}.")
        elif isinstance(value, list) or is_object_array(value):
            # Structures and cells of MATLAB that have one name together.
            elements = {f"[{k}]": x for k, x in enumerate(value)}
            arrays |= _named_arrays(elements, name)
        elif isinstance(value, np.ndarray) and value.ndim > 0:
            # Single rows, as MATLAB writes them, are columns here.
            arrays[name] = value.reshape(-1) if 1 in value.shape else value
        elif is_hdf5_array(value):
            arrays[name] = value
    return arrays


def is_object_array(value: Any) -> bool:
    """Return whether a value is an array of structures or cells."""
    return isinstance(value, np.ndarray) and value.dtype == object and value.ndim > 0


def is_hdf5_array(value: Any) -> bool:
    """Return whether a value of an HDF5 file is an array of numbers, and no image."""
    dimensions = getattr(value, "ndim", 0)
    return dimensions in (1, 2) and value.dtype.itemsize > 1
