"""An example: the files of an experiment on a virtual robot whose truth is known."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.terms import ConstantOffset, RigidBodies, RotorInertia
from jaxid.errors import InputError
from jaxid.io import atomic_folder
from jaxid.measurement.recording import Recording
from jaxid.robot import library
from jaxid.trajectory.fourier import random_fourier_series

from .friction_and_disturbances import SmoothFriction
from .virtual import Sensors, VirtualRobot, random_bodies

FILES = ("experiment.toml", "identification.csv", "verification.csv", "truth.json")


def virtual_panda(seed: int = 0) -> VirtualRobot:
    """Return a robot with the geometry of a Panda and random parameters.

    Masses, rotors and friction vary by some 20 percent about plausible values; the
    bodies can exist. Noise is 1 percent of the largest torques.

    Args:
        seed: Seed of the parameters.
    """
    robot = library.panda()
    random = np.random.default_rng([seed, 0])
    n, largest = robot.joints, np.asarray(robot.max_forces)

    def vary(values: np.ndarray) -> np.ndarray:
        return values * random.uniform(0.8, 1.2, n)

    masses = vary(np.array([3.4, 2.2, 2.6, 2.4, 1.6, 1.3, 0.6]))  # [kg]
    bodies = random_bodies(robot, masses, random)
    friction = SmoothFriction(
        viscous=vary(0.02 * largest),
        coulomb=vary(0.03 * largest),
        stribeck=0.005 * largest,  # friction near standstill that no model has
        stribeck_speed=0.05,
    )
    rotors = vary(np.array([0.6, 0.6, 0.45, 0.45, 0.2, 0.2, 0.15]))  # [kg m²]
    offsets = 0.01 * largest * random.uniform(-1.0, 1.0, n)
    return VirtualRobot(
        robot=robot,
        terms=(RigidBodies(), RotorInertia(), ConstantOffset()),
        values=np.concatenate([bodies.ravel(), rotors, offsets]),
        friction=friction,
        sensors=Sensors(
            encoder_step=2 * math.pi / 2**19,
            white_noise=0.009 * largest,
            coloured_noise=0.004 * largest,
            memory=0.02,
        ),
    )


def virtual_log(
    robot: VirtualRobot, name: str, periods: int, seed: tuple[int, int]
) -> Recording:
    """Return a log of a random motion within the limits, with a period of 8 s, at 500 Hz."""
    first, second = np.random.SeedSequence(seed).generate_state(2, np.uint32).tolist()
    motion = random_fourier_series(
        robot.robot, omega=2 * math.pi / 8.0, reach=0.9, seed=first
    )
    duration = periods * 8.0
    return robot.measure(
        motion, duration=duration, sample_time=0.002, seed=second, name=name
    )


def write_example(folder: Path, seed: int = 0) -> list[Path]:
    """Write an experiment to try: its file, two logs and the truth, all of them or nothing.

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
    with atomic_folder(folder) as staging:
        shutil.copyfile(Path(__file__).with_suffix(".toml"), staging / FILES[0])
        for k, (file, periods) in enumerate(zip(FILES[1:3], (2, 1), strict=True)):
            path = staging / file
            _write_csv(path, virtual_log(robot, path.stem, periods, (seed, k + 1)))
        text = json.dumps(
            _truth(robot, seed), indent=1, ensure_ascii=False, allow_nan=False
        )
        (staging / FILES[3]).write_text(f"{text}\n", encoding="utf-8")
        for file in FILES:
            present, content = folder / file, (staging / file).read_bytes()
            if present.exists() and (
                not present.is_file() or present.read_bytes() != content
            ):
                raise InputError(
                    f"`{present}` exists with other content: choose another folder, "
                    "or remove it."
                )
    return [folder / file for file in FILES]


def _write_csv(path: Path, recording: Recording) -> None:
    n = recording.joints
    header = [
        "time",
        *(f"q{i + 1}" for i in range(n)),
        *(f"tau{i + 1}" for i in range(n)),
    ]
    columns = np.column_stack([recording.time, recording.angles, recording.forces])
    formats = ["%.3f", *["%.7f"] * n, *["%.4f"] * n]
    np.savetxt(
        path,
        columns,
        formats,
        ",",
        header=",".join(header),
        comments="",
        encoding="utf-8",
    )


def _truth(robot: VirtualRobot, seed: int) -> dict[str, object]:
    friction: Any = robot.friction
    model, p = robot.model, np.asarray(robot.parameters)
    base = base_parameters(model)
    combined = np.asarray(base.from_standard(p))
    keys = ("name", "unit", "value")
    standard = zip(
        model.parameter_names, model.parameter_units, p.tolist(), strict=True
    )
    regrouped = zip(base.names, base.units, combined.tolist(), strict=True)
    return {
        "schema": "jaxid-truth/1",
        "robot": model.robot.name,
        "seed": seed,
        "base_parameters": [dict(zip(keys, row, strict=True)) for row in regrouped],
        "standard_parameters": [dict(zip(keys, row, strict=True)) for row in standard],
        "beyond_the_model": {
            "stribeck_friction": np.asarray(friction.stribeck).tolist(),
            "stribeck_speed": friction.stribeck_speed,
            "encoder_step": robot.sensors.encoder_step,
            "white_noise": np.asarray(robot.sensors.white_noise).tolist(),
            "coloured_noise": np.asarray(robot.sensors.coloured_noise).tolist(),
            "noise_memory": robot.sensors.memory,
        },
    }
