"""Draw docs/picture.png: the TX90L on its rail along a motion, and its end-effector."""

from pathlib import Path

import jax
import numpy as np
from PIL import Image

import jaxid as jid

OMEGA = 0.8
"""Base frequency of the motion, as in the paper [rad/s]."""
HEIGHT = 560
"""Height of the picture [pixel]."""


def main() -> None:
    """Draw both figures side by side."""
    jax.config.update("jax_enable_x64", True)
    robot = jid.robots.tx90l_on_rail()
    time = np.linspace(0.0, 7.85, 400)
    motion = jid.random_fourier_series(robot, omega=OMEGA, seed=3).motion(time)
    figures = (
        jid.plot.poses(robot, motion.q, poses=4, title="TX90L on rail: a motion"),
        jid.plot.end_effector(robot, time, motion),
    )
    path = Path(__file__).parent / "picture.png"
    parts = []
    for figure in figures:
        figure.save(path)
        with Image.open(path) as part:
            width = round(part.width * HEIGHT / part.height)
            parts.append(part.convert("RGB").resize((width, HEIGHT), Image.Resampling.LANCZOS))
    whole = Image.new("RGB", (sum(part.width for part in parts), HEIGHT), "white")
    left = 0
    for part in parts:
        whole.paste(part, (left, 0))
        left += part.width
    whole.quantize(256, Image.Quantize.FASTOCTREE).save(path, optimize=True)


if __name__ == "__main__":
    main()
