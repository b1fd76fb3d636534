"""Files of arrays: NPZ, MAT of any version, and HDF5."""

import contextlib
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from jaxid.errors import InputError
from jaxid.io import import_extra


@contextlib.contextmanager
def readable(source: str, kind: str) -> Iterator[None]:
    """Report a file that a library cannot read as damaged."""
    try:
        yield
    except InputError:
        raise
    except (Exception, pl.exceptions.PanicException) as error:
        # Of many kinds: it depends on which bytes are damaged.
        said = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
        raise InputError(f"`{source}` is no {kind}, or is damaged: {said}.") from error


def read_mat(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a MAT file of any version."""
    from scipy.io import loadmat

    with path.open("rb") as file:
        if b"\x89HDF" in file.read(516):
            # Version 7.3 is HDF5, in which the arrays are transposed.
            return _named_arrays(
                {name: array.T for name, array in read_hdf5(path).items()}
            )
    with readable(path.name, "MAT file"):
        content = loadmat(path, simplify_cells=True)
    return _named_arrays(
        {k: value for k, value in content.items() if not k.startswith("__")}
    )


def read_hdf5(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of an HDF5 file but its images; those in a group are named like `log.q`."""
    h5py = import_extra("h5py", "logs", f"`{path.name}` is read by")
    with readable(path.name, "HDF5 file"), h5py.File(path, "r") as file:
        return _named_arrays(file)


def with_elements(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Add the columns of arrays, named like `q[0]`."""
    wide = {
        name: a for name, a in arrays.items() if a.ndim == 2 and a.shape[1] <= len(a)
    }
    columns = {
        f"{name}[{k}]": a[:, k] for name, a in wide.items() for k in range(a.shape[1])
    }
    return arrays | columns


def _named_arrays(
    content: Mapping[str, Any], prefix: str = ""
) -> dict[str, np.ndarray]:
    """Return arrays by name; those in a structure are named like `log.q`."""
    arrays: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if isinstance(value, Mapping):
            arrays |= _named_arrays(value, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray) and value.ndim > 0:
            # Single rows, as MATLAB writes them, are columns here.
            arrays[prefix + name] = value.ravel() if 1 in value.shape else value
        elif (
            getattr(value, "ndim", 0) in (1, 2) and value.dtype.itemsize > 1
        ):  # of HDF5
            arrays[prefix + name] = value[()]
    return arrays


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of an NPZ file; objects, which could run code, are rejected."""
    kind = "NPZ file of plain arrays (`numpy.savez`, without objects)"
    with readable(path.name, kind), path.open("rb") as file, np.load(file) as archive:
        # A member that NumPy did not write comes as bytes, which are left out.
        return _named_arrays({name: archive[name] for name in archive.files})


def map_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """Map the arrays of an NPZ file into memory; None if one is compressed or none is there."""
    arrays = {}
    with (
        readable(path.name, "NPZ file"),
        zipfile.ZipFile(path) as archive,
        path.open("rb") as file,
    ):
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
    return _named_arrays(arrays) or None
