"""An example: the files of an experiment on a virtual robot whose truth is known."""

import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.terms import ConstantOffset, RigidBodies, RotorInertia
from jaxid.errors import InputError
from jaxid.io import atomic_folder
from jaxid.measurement.recording import Recording
from jaxid.robot import library
from jaxid.trajectory.fourier import random_fourier_series

from .friction_and_ripple import SmoothFriction
from .virtual import Sensors, VirtualRobot, random_bodies

FILES = ("experiment.toml", "identification.csv", "verification.csv", "truth.json")
"""Names of the files of an example."""
PERIOD = 8.0
"""Period of the motions of its logs [s]."""


def virtual_panda(seed: int = 0) -> VirtualRobot:
    """Return a robot with the geometry of a Panda and random parameters.

    Masses, rotors and friction vary by some 20 percent about plausible values; the
    bodies can exist. Noise is 1 percent of the largest torques.

    Args:
        seed: Seed of the parameters.
    """
    robot = library.panda()
    random = np.random.default_rng([seed, 0])
    n = robot.joints
    max_forces = np.asarray(robot.max_forces)

    def vary(values):
        return values * random.uniform(0.8, 1.2, n)

    masses = vary(np.array([3.4, 2.2, 2.6, 2.4, 1.6, 1.3, 0.6]))  # [kg]
    bodies = random_bodies(robot, masses, random)
    friction = SmoothFriction(
        viscous=vary(0.02 * max_forces),
        coulomb=vary(0.03 * max_forces),
        stribeck=0.005 * max_forces,  # friction near standstill that no model has
        stribeck_speed=0.05,
    )
    rotors = vary(np.array([0.6, 0.6, 0.45, 0.45, 0.2, 0.2, 0.15]))  # [kg m²]
    offsets = 0.01 * max_forces * random.uniform(-1.0, 1.0, n)
    return VirtualRobot(
        robot=robot,
        terms=(RigidBodies(), RotorInertia(), ConstantOffset()),
        values=np.concatenate([bodies.ravel(), rotors, offsets]),
        friction=friction,
        sensors=Sensors(
            encoder_step=2 * math.pi / 2**19,
            white_noise=0.009 * max_forces,
            coloured_noise=0.004 * max_forces,
            memory=0.02,
        ),
    )


def virtual_log(
    robot: VirtualRobot, name: str, periods: int, seed: tuple[int, int]
) -> Recording:
    """Return a log of a random motion within the limits, with 8 s period, at 500 Hz."""
    seeds = np.random.SeedSequence(seed).generate_state(2, np.uint32).tolist()
    motion = random_fourier_series(
        robot.robot, omega=2 * math.pi / PERIOD, reach=0.9, seed=seeds[0]
    )
    return robot.measure(
        motion,
        duration=periods * PERIOD,
        sample_time=0.002,
        seed=seeds[1],
        name=name,
    )


def write_example(folder: Path, seed: int = 0) -> list[Path]:
    """Write an experiment to try: its file, two logs and the truth; all or nothing.

    Args:
        folder: Folder of the files; made with its parents.
        seed: Seed of the parameters, the motions and the noise.

    Returns:
        Paths of the files.

    Raises:
        InputError: If `folder` is a file, or contains one of the files with other
            content.
        RuntimeError: If JAX runs in single precision.
    """
    robot = virtual_panda(seed)
    experiment, identification, verification, truth = FILES
    periods = {identification: 2, verification: 1}
    with atomic_folder(folder) as staging:
        shutil.copyfile(Path(__file__).with_suffix(".toml"), staging / experiment)
        for k, (file, count) in enumerate(periods.items()):
            path = staging / file
            _write_csv(path, virtual_log(robot, path.stem, count, (seed, k + 1)))
        content = _truth(robot, seed)
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
        (staging / truth).write_text(f"{text}\n", encoding="utf-8")
        for file in FILES:
            _require_no_other(folder / file, (staging / file).read_bytes())
    return [folder / file for file in FILES]


def _require_no_other(path: Path, content: bytes):
    """Refuse to overwrite a file with other content."""
    if path.is_file() and path.read_bytes() == content:
        return
    if path.exists():
        raise InputError(
            f"`{path}` exists with other content: choose another folder, or remove it."
        )


def _write_csv(path: Path, recording: Recording):
    joints = range(1, recording.joints + 1)
    names = ["time", *(f"q{i}" for i in joints), *(f"tau{i}" for i in joints)]
    columns = [recording.time, recording.angles, recording.forces]
    formats = ["%.3f", *["%.7f"] * len(joints), *["%.4f"] * len(joints)]
    np.savetxt(
        path,
        np.column_stack(columns),
        formats,
        delimiter=",",
        header=",".join(names),
        comments="",
        encoding="utf-8",
    )


def _truth(robot: VirtualRobot, seed: int):
    """Return the true parameters, and what no model of the experiment contains."""
    friction: Any = robot.friction
    sensors = robot.sensors
    model = robot.model
    p = np.asarray(robot.parameters)
    base = base_parameters(model)
    return {
        "schema": "jaxid-truth/1",
        "robot": model.robot.name,
        "seed": seed,
        "base_parameters": _rows(base.names, base.units, base.from_standard(p)),
        "standard_parameters": _rows(model.parameter_names, model.parameter_units, p),
        "beyond_the_model": {
            "stribeck_friction": np.asarray(friction.stribeck).tolist(),
            "stribeck_speed": friction.stribeck_speed,
            "encoder_step": sensors.encoder_step,
            "white_noise": np.asarray(sensors.white_noise).tolist(),
            "coloured_noise": np.asarray(sensors.coloured_noise).tolist(),
            "noise_memory": sensors.memory,
        },
    }


def _rows(names: Sequence[str], units: Sequence[str], values: ArrayLike):
    rows = zip(names, units, np.asarray(values).tolist(), strict=True)
    return [{"name": name, "unit": unit, "value": x} for name, unit, x in rows]
