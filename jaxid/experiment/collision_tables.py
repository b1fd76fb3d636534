"""The table `[collision]` becomes shapes and the pairs that must stay apart."""

from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.experiment.robot_tables import within
from jaxid.experiment.tables import BoxTable, CapsuleTable, CollisionTable, Tables
from jaxid.robot import library
from jaxid.robot.collision import (
    GROUND,
    AbstractObstacle,
    Box,
    Capsule,
    CollisionModel,
    HalfSpace,
    fit_capsules,
)
from jaxid.robot.kinematics import rpy_rotation
from jaxid.robot.plausibility import SNAP_TOLERANCE
from jaxid.robot.robot import Robot

BUILTIN_SHAPES = {"tx90l_on_rail": library.tx90l_on_rail_collision}
"""Robots of the library whose shapes are in the library too."""


def build_collision(tables: Tables, robot: Robot, path: Path) -> CollisionModel | None:
    """Makes the collision model of an experiment file; None if it has no table `[collision]`.

    Args:
        tables: The file's.
        robot: Of the file.
        path: Of the file: other paths are relative to its folder.

    Raises:
        InputError: If shapes cannot be made; the message names file and table.
    """
    table = tables.collision
    if table is None:
        return None
    with within(path.name, "collision"):
        capsules, obstacles, pairs = _given(tables, table, path)
        capsules += [_capsule(robot, one) for one in table.capsules]
        obstacles += [_box(one) for one in table.boxes]
        if table.ground is not None:
            obstacles.append(HalfSpace("ground", height=table.ground))
        if table.pairs is not None:
            pairs = table.pairs
        return CollisionModel(robot, capsules, obstacles, pairs)


def _given(
    tables: Tables, table: CollisionTable, path: Path
) -> tuple[list[Capsule], list[AbstractObstacle], list[tuple[str, str]] | None]:
    """Shapes that the robot's source knows, and its pairs if it knows those too."""
    source = tables.robot
    if table.fit and source.urdf is not None:
        fitted = fit_capsules(
            path.parent / source.urdf,
            tip=source.tip,
            base=source.base,
            base_rotation=None
            if source.base_rotation is None
            else rpy_rotation(np.deg2rad(source.base_rotation)),
            base_position=(0.0, 0.0, 0.0) if source.base_position is None else source.base_position,
            packages=None if table.packages is None else path.parent / table.packages,
            snap_tolerance=SNAP_TOLERANCE
            if source.snap_tolerance is None
            else source.snap_tolerance,
        )
        return list(fitted), [], None
    if table.fit and source.builtin in BUILTIN_SHAPES:
        if source.base_rotation is not None or source.base_position is not None:
            raise InputError(
                "`fit` knows the built-in robot only where it stands by itself: leave out "
                "`robot.base_rotation` and `robot.base_position`, or give `capsules`."
            )
        model = BUILTIN_SHAPES[source.builtin]()
        names = [s.name for s in (*model.capsules, *model.obstacles)]
        contacts = [(i, len(model.capsules) + k) for i, k in model.contacts]
        pairs = [(names[i], names[k]) for i, k in (*model.pairs, *contacts)]
        # Whoever adds shapes wants them watched: then all pairs are found anew.
        alone = not table.capsules and not table.boxes and table.ground is None
        obstacles = [o for o in model.obstacles if table.ground is None or o.name != "ground"]
        return list(model.capsules), obstacles, pairs if alone else None
    if table.fit:
        raise InputError(
            "`fit` needs `robot.urdf` or a built-in robot whose shapes are known "
            f"({', '.join(BUILTIN_SHAPES)}): give `capsules` instead."
        )
    return [], [], None


def _capsule(robot: Robot, table: CapsuleTable) -> Capsule:
    bodies = {"ground": GROUND, **{name: j for j, name in enumerate(robot.joint_names)}}
    if table.body not in bodies:
        raise InputError(
            f"`body` of capsule `{table.name}` must be `ground` or the name of the joint that "
            f'moves it ({", ".join(robot.joint_names)}), but is "{table.body}".'
        )
    return Capsule(
        table.name, bodies[table.body], start=table.start, end=table.end, radius=table.radius
    )


def _box(table: BoxTable) -> Box:
    rotation = None if table.rotation is None else rpy_rotation(np.deg2rad(table.rotation))
    return Box(table.name, centre=table.centre, size=table.size, rotation=rotation)
