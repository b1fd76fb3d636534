"""Files of arrays, which have names like `q` and columns like `q[0]`."""

import abc
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError
from jaxid.io import import_extra

from .log_file import AbstractLogFile, Selections, has_column, selected_names
from .log_table import LogTable, readable

MAX_COMPRESSION = 2000
"""Largest size of an array, relative to that of its file: deflate reaches 1032."""
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
            if array.ndim == 2 and array.shape[1] <= len(array):
                for k in range(array.shape[1]):
                    columns[f"{name}[{k}]"] = array[:, k]
        return arrays | columns

    @property
    def names(self):  # noqa: D102
        return tuple(self.arrays)

    def table(self, channels, on_disk, bad_rows):  # noqa: D102
        return LogTable(self.path.name, self.arrays, channels, bad_rows=bad_rows)


class NpzFile(AbstractArrayFile):
    """NPZ file of NumPy."""

    def load(self):  # noqa: D102
        # Objects, which could run code, are rejected.
        kind = "NPZ file of plain arrays (`numpy.savez`, without objects)"
        with (
            readable(self.path.name, kind),
            self.path.open("rb") as file,
            np.load(file) as archive,
        ):
            # A member that NumPy did not write comes as bytes, which are left out.
            return _named_arrays({name: archive[name] for name in archive.files})


class MatFile(AbstractArrayFile):
    """MAT file of MATLAB, of any version."""

    def load(self):  # noqa: D102
        from scipy.io import loadmat

        with self.path.open("rb") as file:
            head = file.read(516)
        if b"\x89HDF" in head:
            # Version 7.3 is HDF5, in which the arrays are transposed.
            arrays = read_hdf5(self.path, self.selections)
            return _named_arrays({name: array.T for name, array in arrays.items()})
        with readable(self.path.name, "MAT file"):
            content = loadmat(self.path, simplify_cells=True)
        variables = {name: x for name, x in content.items() if name[:2] != "__"}
        return _named_arrays(variables)


class Hdf5File(AbstractArrayFile):
    """HDF5 file; arrays in a group are named like `log.q`."""

    def load(self):  # noqa: D102
        return read_hdf5(self.path, self.selections)


def read_hdf5(path: Path, selections: Selections) -> Arrays:
    """Read the selected arrays of an HDF5 file, without images.

    Those in a group are named like `log.q`. Others hold NaN, and need no memory.
    """
    h5py = import_extra("h5py", "logs", f"`{path.name}` is read by")
    wanted_names = [name.partition("[")[0] for name in selected_names(selections)]
    max_size = MAX_COMPRESSION * path.stat().st_size
    arrays: Arrays = {}
    with readable(path.name, "HDF5 file"), h5py.File(path, "r") as file:
        for name, dataset in _named_arrays(file).items():
            is_wanted = any(has_column([name], wanted) for wanted in wanted_names)
            if not is_wanted:
                arrays[name] = np.broadcast_to(np.nan, dataset.shape)
            elif dataset.nbytes > max_size:
                raise InputError(
                    f"`{name}` of `{path.name}` declares {dataset.nbytes:.3g} bytes, "
                    f"but the whole file has {path.stat().st_size}: write it again "
                    "with the samples that were recorded only."
                )
            else:
                arrays[name] = dataset[()]
    return arrays


def _named_arrays(content: Mapping[str, Any], prefix: str = "") -> Arrays:
    """Return arrays by name; those in a structure are named like `log.q`."""
    arrays: Arrays = {}
    for key, value in content.items():
        name = prefix + key
        if isinstance(value, Mapping):
            arrays |= _named_arrays(value, f"{name}.")
        elif isinstance(value, np.ndarray) and value.ndim > 0:
            # Single rows, as MATLAB writes them, are columns here.
            arrays[name] = value.reshape(-1) if 1 in value.shape else value
        elif is_hdf5_array(value):
            arrays[name] = value
    return arrays


def is_hdf5_array(value: Any) -> bool:
    """Return whether a value of an HDF5 file is an array of numbers, and no image."""
    dimensions = getattr(value, "ndim", 0)
    return dimensions in (1, 2) and value.dtype.itemsize > 1
