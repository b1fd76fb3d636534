"""Draw docs/picture.png: the TX90L on its rail along a motion."""

from pathlib import Path

import jax
import numpy as np

import jaxid as jid

OMEGA = 0.8
"""Base frequency of the motion, as in the paper [rad/s]."""


def main() -> None:
    """Draw the figure."""
    jax.config.update("jax_enable_x64", True)
    robot = jid.robots.tx90l_on_rail()
    time = np.linspace(0.0, 7.85, 400)
    motion = jid.trajectories.random_fourier_series(robot, omega=OMEGA, seed=3).motion(
        time
    )
    figure = jid.plot.poses(
        robot, motion.q, time, poses=4, title="TX90L on rail: a motion"
    )
    figure.save(Path(__file__).with_name("picture.png"))


if __name__ == "__main__":
    main()
