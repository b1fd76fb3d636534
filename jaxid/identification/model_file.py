"""Model files: a fit read again, with everything that it contains."""

import re
from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.io import from_json, read_json

from .fit_result import FORMAT, VERSION, Fit, checksum_of


def load_fit(path: str | Path) -> Fit:
    """Read a fit from a model file, as `Fit.save` and `jaxid identify` write it.

    Numbers are the same to the last bit, and everything works as it did after
    `identify`. Your own terms are found if the module that defines them is imported;
    nothing in a file is executed.

    Args:
        path: Path of the file.

    Raises:
        OSError: If the file cannot be read.
        InputError: If it is not a model file, of another version, or not as it was
            written.
    """
    try:
        document = read_json(path)
    except ValueError as error:
        raise InputError(
            f"`{path}` is not a model file: it cannot be read as JSON."
        ) from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(f"`{path}` is not a model file, as `save` writes it.")
    if document.get("version") != VERSION:
        raise InputError(
            f"`{path}` is a model file of version {document.get('version')!r:.20}, "
            f"but this jaxid reads version {VERSION}: identify again."
        )
    content = document.get("model")
    if document.get("checksum") != checksum_of(content):
        raise InputError(
            f"`{path}` is damaged or was changed by hand: save the model again."
        )
    try:
        fit = from_json(content, Fit)
        _check(fit)
    except (ValueError, TypeError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"`{path}` holds no model that can be used: {reason}."
        ) from error
    return fit


def _check(fit: Fit) -> None:
    """Reject arrays of a file that do not belong to its robot."""
    base = fit.base
    n = base.size
    joints = base.model.robot.joints
    parameters = sorted((*base.indices, *base.dependent))
    if parameters != [*range(base.model.size)]:
        raise InputError("`indices` and `dependent` must hold each parameter once")
    arrays = {
        "kappa": (base.kappa, (n, len(base.dependent))),
        "parameters": (fit.parameters, (n,)),
        "covariance": (fit.covariance, (n, n)),
        "weights": (fit.weights, (joints,)),
    }
    for name, (array, shape) in arrays.items():
        if np.shape(array) != shape:
            raise InputError(
                f"`{name}` must have the shape {shape}, but has {np.shape(array)}"
            )
    if not np.isfinite(fit.parameters).all():
        raise InputError("`parameters` must hold finite numbers")
    if not re.fullmatch(r"(\d{4}-\d{2}-\d{2})?", fit.date, re.ASCII):
        raise InputError(f"`date` must be like 2026-01-31, but is {fit.date!r:.40}")
    texts = [fit.name, *fit.recordings, *fit.notes, *base.names, *base.units]
    for text in texts:
        if not text.isprintable():
            raise InputError(f"the text {text!r:.40} must be printable")
