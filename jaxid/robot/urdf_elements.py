"""Elements of a URDF file: attributes, numbers and attitudes, and errors about them."""

from typing import Any

import numpy as np
import scipy

from jaxid.arrays import Matrix3, Vector
from jaxid.errors import InputError

from .rotations import rpy_rotation

ORIGIN = (0.0, 0.0, 0.0)
"""Position, or roll, pitch and yaw, where a file states none."""


class UrdfElements:
    """Elements of a URDF file, which are read with errors that name file and line.

    Attributes:
        path: Path of the file.
        root: Element of the robot.
    """

    path: str
    root: Any

    def named(self, tag: str):
        """Return the elements of a tag by their names."""
        elements: dict[str, Any] = {}
        for element in self.root.iterfind(tag):
            name = self.attribute(element, "name")
            if name in elements:
                raise InputError(
                    f"`{self.path}` has two {tag}s named `{name}`: rename one."
                )
            elements[name] = element
        return elements

    def place(self, element: Any) -> str:
        """Return file and line of an element, for messages."""
        line = element.sourceline  # None if the file is MJCF
        return f"`{self.path}`, line {line}" if line else f"`{self.path}`"

    def error(self, joint: Any, complaint: str) -> InputError:
        """Return an error about a joint, which names the file and the joint."""
        return InputError(f"`{self.path}`: joint `{joint.get('name')}` {complaint}.")

    def attribute(self, element: Any, key: str):
        """Return an attribute that an element must have."""
        if element.get(key) is None:
            raise InputError(
                f"{self.place(element)}: `<{element.tag}>` needs the attribute {key}."
            )
        return element.get(key)

    def numbers(
        self,
        element: Any,
        key: str,
        default: tuple[float, ...],
        *,
        infinite: bool = False,
    ) -> Vector:
        """Return the numbers of an attribute, or the default if it is missing."""
        text = None if element is None else element.get(key)
        if text is None:
            return np.array(default)
        try:
            words = text.replace(", ", " ").split()
            array = np.array([float(word) for word in words])
        except ValueError:
            array = np.zeros(0)
        is_number = ~np.isnan(array) if infinite else np.isfinite(array)
        if array.shape != (len(default),) or not is_number.all():
            noun = "number" if len(default) == 1 else "numbers"
            raise InputError(
                f"{self.place(element)}: `{key}` must hold "
                f'{len(default)} finite {noun}, but is "{text}".'
            )
        return array

    def attitude(self, origin: Any) -> Matrix3:
        """Return the attitude that an `<origin>` states, as angles or a quaternion."""
        if origin is None or origin.get("quat_xyzw") is None:
            return rpy_rotation(self.numbers(origin, "rpy", ORIGIN))
        quaternion = self.numbers(origin, "quat_xyzw", (0.0, 0.0, 0.0, 1.0))
        size = np.abs(quaternion).max()
        if size < 1e-9:
            raise InputError(
                f"{self.place(origin)}: `quat_xyzw` must not be zero: "
                'for no rotation give "0 0 0 1".'
            )
        turn = scipy.spatial.transform.Rotation.from_quat(quaternion / size)
        return turn.as_matrix()
