"""Files of arrays: NPZ, MAT of any version, and HDF5."""

import contextlib
import importlib
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError


def library(module: str, source: str) -> Any:
    """Return a module of the extra `logs`.

    Raises:
        InputError: If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"`{source}` is read by the package `{module.partition('.')[0]}`: install it "
            '(`pip install "jaxid-robotics[logs]"`).'
        ) from error


@contextlib.contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Report a file that a library cannot read as damaged."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # of many kinds: it depends on which bytes are damaged
        raise InputError(
            f"`{path.name}` is no {kind}, or is damaged: {first_line(error)}."
        ) from error


def first_line(error: BaseException) -> str:
    """Return what an error of a library says, in one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def read_mat(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a MAT file of any version."""
    from scipy.io import loadmat

    try:
        with readable(path, "MAT file"):
            content = loadmat(path, simplify_cells=True)
    except InputError as error:
        if not isinstance(error.__cause__, NotImplementedError):
            raise
        # Version 7.3 is HDF5, in which MATLAB's arrays are transposed.
        arrays = read_hdf5(path).items()
        return _named_arrays({name.replace("/", "."): array.T for name, array in arrays})
    return _named_arrays({k: value for k, value in content.items() if not k.startswith("__")})


def read_hdf5(path: Path) -> dict[str, np.ndarray]:
    """Read the numbers in an HDF5 file but its images, named like `group/q`."""
    h5py = library("h5py", path.name)
    arrays: dict[str, np.ndarray] = {}

    def read(name: str, item: Any) -> None:
        is_array = isinstance(item, h5py.Dataset) and item.ndim in (1, 2)
        if is_array and item.dtype.kind in "iuf" and item.dtype.itemsize > 1:
            arrays[name] = item[()]

    with readable(path, "HDF5 file"), h5py.File(path, "r") as file:
        file.visititems(read)
    return arrays


def with_elements(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Add the columns of arrays, named like `q[0]`."""
    wide = {name: a for name, a in arrays.items() if a.ndim == 2 and a.shape[1] <= len(a)}
    columns = {f"{name}[{k}]": a[:, k] for name, a in wide.items() for k in range(a.shape[1])}
    return arrays | columns


def _named_arrays(content: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return arrays by name; those in a structure are named like `log.q`."""
    arrays: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            arrays |= _named_arrays(value, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray) and value.ndim > 0:
            # Single rows, as MATLAB writes them, are columns here.
            arrays[prefix + name] = value.ravel() if 1 in value.shape else value
    return arrays


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of an NPZ file; objects, which could run code, are rejected."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            # A member that NumPy did not write comes as bytes, which are left out.
            return _named_arrays({name: archive[name] for name in archive.files})
    except Exception as error:  # some ten kinds: it depends on which bytes are damaged
        raise InputError(
            f"`{path.name}` is no NPZ file of plain arrays ({first_line(error)}): save it by "
            "`numpy.savez`, without objects."
        ) from error


def map_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """Map the arrays of an NPZ file into memory; None if one is compressed or none is there."""
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            for entry in archive.infolist():
                if entry.compress_type != zipfile.ZIP_STORED:
                    return None
                file.seek(entry.header_offset + 26)
                lengths = np.frombuffer(file.read(4), "<u2")
                file.seek(entry.header_offset + 30 + int(lengths.sum()))
                np.lib.format.read_magic(file)
                shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
                order = "F" if fortran else "C"
                array = np.memmap(path, dtype, "r", file.tell(), shape, order)
                arrays[entry.filename.removesuffix(".npy")] = array
    except Exception as error:  # of many kinds: it depends on which bytes are damaged
        raise InputError(
            f"`{path.name}` is no NPZ file of numbers, or is damaged: {first_line(error)}."
        ) from error
    return _named_arrays(arrays) or None
