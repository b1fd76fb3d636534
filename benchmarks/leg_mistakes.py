"""What is said of wrong columns of robots on legs, and whether the cure helps.

MuJoCo records a log of each robot (`floating.py`), whose columns are then spoilt in one
way after another. A mistake is named if its finding is the only one when the log is
read, as ✗. Then the key that this finding names is set, with the number that it states.
Errors are those of the torques in another motion (least squares), relative to those of
the clean log. The limits of the search were set on a Go2, an A1 and an ANYmal C.

    python benchmarks/leg_mistakes.py                 # all robots: 40 minutes
    python benchmarks/leg_mistakes.py --robot HyQ --mistake "legs exchanged: angles"
"""

import argparse
import dataclasses
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from designed_legs import A1
from floating import (
    ANYMAL,
    COLUMNS,
    GO2,
    Study,
    write,
)
from timing import Row, hand_over

import jaxid as jid

LAIKAGO = GO2._replace(
    path="laikago_description/urdf/laikago.urdf",
    feet={f"{leg}_foot": jid.Sphere(0.0265) for leg in ("FR", "FL", "RR", "RL")},
    stiffness=600.0,
    rate_gain=10.0,
    torque=80.0,
)
B1 = LAIKAGO._replace(
    path="b1_description/urdf/b1.urdf",
    feet={f"{leg}_foot": jid.Sphere(0.03) for leg in ("FL", "FR", "RL", "RR")},
    stiffness=800.0,
    rate_gain=20.0,
    torque=250.0,
)
ANYMAL_B = ANYMAL._replace(
    path="anymal_b_simple_description/robots/anymal.urdf",
    feet={f"{leg}_FOOT": jid.Sphere(0.031) for leg in ("LF", "RF", "LH", "RH")},
)
HYQ = ANYMAL._replace(
    path="hyq_description/robots/hyq_no_sensors.urdf",
    feet={f"{leg}_foot": jid.Sphere(0.02175) for leg in ("lf", "rf", "lh", "rh")},
    pose={"f_hfe": 0.75, "f_kfe": -1.5, "h_hfe": -0.75, "h_kfe": 1.5},
    stiffness=1500.0,
    rate_gain=40.0,
    torque=250.0,
)
ROBOTS = {
    "Go2": GO2,
    "A1": A1,
    "ANYmal C": ANYMAL,
    "Laikago": LAIKAGO,
    "HyQ": HYQ,
    "ANYmal B": ANYMAL_B,
    "B1": B1,
}
Log = dict[str, np.ndarray]
NAMES = {"angles": "q", "forces": "tau", "contact": "contact"}
LEGS_EXCHANGED = [3, 4, 5, 0, 1, 2, 6, 7, 8, 9, 10, 11]
DIAGONAL_LEGS_EXCHANGED = [9, 10, 11, 3, 4, 5, 6, 7, 8, 0, 1, 2]


class Mistake(NamedTuple):
    """A mistake in the columns of a log.

    Attributes:
        spoilt: Log with the mistake.
        words: Words of the finding that names it.
        cure: Columns that mend it, as the finding says.
        places: Beginnings of the names of joints, legs and feet that it must name.
    """

    spoilt: Callable[[Log], Log]
    words: tuple[str, ...]
    cure: Callable[[str], dict[str, Any]]
    places: Callable[[jid.Robot], list[str]] = lambda robot: []


def joints_named(*joints: int) -> Callable[[jid.Robot], list[str]]:
    """Return the names of some of twelve joints, as a finding writes them."""
    return lambda robot: [f"`{robot.joint_names[6 + joint]}`" for joint in joints]


def legs_named(*joints: int) -> Callable[[jid.Robot], list[str]]:
    """Return the two letters with which all names of a joint's leg begin."""
    return lambda robot: [f"`{robot.joint_names[6 + joint][:2]}" for joint in joints]


def feet_named(*feet: int) -> Callable[[jid.Robot], list[str]]:
    """Return the names of feet."""
    return lambda robot: [f"`{robot.contacts[foot].name}`" for foot in feet]


def factors(joint: int, factor: float) -> np.ndarray:
    """Return a factor of one of twelve joints."""
    return np.where(np.arange(12) == joint, factor, 1.0)


def wrong_signs(joint: int, *channels: str) -> Mistake:
    """Return wrong signs of the columns of a joint."""
    signs = factors(joint, -1.0)
    keys = {"angles": "angle_signs", "forces": "force_signs"}
    return Mistake(
        lambda log: log | {channel: log[channel] * signs for channel in channels},
        tuple(keys[channel] for channel in channels),
        lambda text: {keys[channel]: tuple(signs) for channel in channels},
        joints_named(joint),
    )


def wrong_scale(joint: int, factor: float) -> Mistake:
    """Return a wrong scale of the torque of a joint."""

    def cure(text: str) -> dict[str, Any]:
        number = re.search(r"`recording.force_gains` of ([0-9.e-]+)", text)
        return {"force_gains": tuple(factors(joint, float(number[1])))}

    return Mistake(
        lambda log: log | {"forces": log["forces"] * factors(joint, factor)},
        ("force_gains",),
        cure,
        joints_named(joint),
    )


def exchanged(
    order: list[int], places: Callable[[jid.Robot], list[str]], *channels: str
) -> Mistake:
    """Return columns in another order, which is its own inverse."""

    def cure(text: str) -> dict[str, Any]:
        columns = [(channel, NAMES[channel]) for channel in channels]
        return {
            channel: tuple(f"{name}{k + 1}" for k in order) for channel, name in columns
        }

    return Mistake(
        lambda log: log | {channel: log[channel][:, order] for channel in channels},
        ("exchanged", f"`recording.{channels[0]}`"),
        cure,
        places,
    )


def pair(i: int, j: int) -> list[int]:
    """Return twelve columns with two of them exchanged."""
    order = list(range(12))
    order[i], order[j] = j, i
    return order


MISTAKES = {
    "torque of a thigh: sign": wrong_signs(4, "forces"),
    "torque of a knee: sign": wrong_signs(11, "forces"),
    "torque of a knee: in mNm": wrong_scale(5, 1000.0),
    "torque of a hip: gear of 9 missing": wrong_scale(6, 1 / 9),
    "torque of a thigh: 20 % too small": wrong_scale(1, 0.8),
    "torques of a leg's thigh and knee exchanged": exchanged(
        pair(1, 2), joints_named(1, 2), "forces"
    ),
    "torques of two thighs exchanged": exchanged(
        pair(4, 10), joints_named(4, 10), "forces"
    ),
    "legs exchanged: torques": exchanged(LEGS_EXCHANGED, legs_named(0, 3), "forces"),
    "legs exchanged: angles": exchanged(LEGS_EXCHANGED, legs_named(0, 3), "angles"),
    "legs exchanged: both": exchanged(
        LEGS_EXCHANGED, legs_named(0, 3), "angles", "forces"
    ),
    "diagonal legs exchanged: both": exchanged(
        DIAGONAL_LEGS_EXCHANGED, legs_named(0, 9), "angles", "forces"
    ),
    "encoder of a hip: sign": wrong_signs(0, "angles"),
    "encoder of a knee: sign": wrong_signs(11, "angles"),
    "encoder and torque of a thigh: sign": wrong_signs(7, "angles", "forces"),
    "flags inverted": Mistake(
        lambda log: log | {"contact": 1.0 - log["contact"]},
        ("contact_inverted",),
        lambda text: {"contact_inverted": True},
    ),
    "flags of two feet exchanged": exchanged([1, 0, 2, 3], feet_named(0, 1), "contact"),
    "flags of left and right exchanged": exchanged(
        [1, 0, 3, 2], feet_named(0, 1, 2, 3), "contact"
    ),
}


class Examination(NamedTuple):
    """What is said of a log, and the error of its least-squares fit.

    Attributes:
        texts: Mistakes, and what needs a look.
        count: Number of mistakes, which stand first and alone.
        error: Torque error on another motion.
    """

    texts: tuple[str, ...]
    count: int
    error: float


def examined(study: Study, log: Log, **cure: Any) -> Examination:
    """Return what is said of a log when it is read, with other columns."""
    columns = dataclasses.replace(COLUMNS, **cure)
    with tempfile.TemporaryDirectory() as folder:
        path = write(log, Path(folder) / "log.csv", 1)
        read = jid.read_recording(path, columns)
    checked = jid.workflow.check_contacts(study.base, read, study.setup.filter)
    rows = study.setup.observe(checked.recording)
    fit = jid.identify(study.base, rows)
    texts = (*checked.mistakes, *checked.findings)
    return Examination(texts, len(checked.mistakes), study.torque_error(fit))


def verdict(study: Study, log: Log, mistake: Mistake, clean_error: float) -> str:
    """Return whether a mistake alone is named, and what its cure leaves."""
    spoilt_log = mistake.spoilt(log)
    spoilt = examined(study, spoilt_log)
    ratio = spoilt.error / clean_error
    text = spoilt.texts[0] if spoilt.texts else ""
    print(f"    {text}", flush=True)
    places = mistake.places(study.base.model.robot)
    is_named = all(words in text for words in (*mistake.words, *places))
    if not is_named or spoilt.count != 1 or len(spoilt.texts) > 1:
        return f"{ratio:.1f} times the error, NOT NAMED ({len(spoilt.texts)} findings)"
    mended = examined(study, spoilt_log, **mistake.cure(text))
    cured_ratio = mended.error / clean_error
    others = f", {len(mended.texts)} FINDINGS" if mended.texts else ""
    return f"named; {ratio:.1f} times the error, cured {cured_ratio:.2f}{others}"


def rows_of(name: str, mistakes: list[str], seconds: float) -> list[Row]:
    """Return what is said of each mistake in a log of a robot."""
    study = Study(ROBOTS[name], seconds)
    log = study.log(1)
    clean = examined(study, log)
    print(name, "clean", f"{100 * clean.error:.2f} %", clean.texts, flush=True)
    recipe = f"leg_mistakes.py, one log of {seconds:g} s"
    text = f"{len(clean.texts)} findings"
    rows = [Row("43", f"{name}: clean log", recipe, "0", text, not clean.texts)]
    for what in mistakes:
        text = verdict(study, log, MISTAKES[what], clean.error)
        print(name, what, text, sep="; ", flush=True)
        is_right = text.startswith("named")
        rows.append(Row("43", f"{name}: {what}", recipe, "named", text, is_right))
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", choices=ROBOTS, help="all if left out")
    parser.add_argument("--mistake", choices=MISTAKES, help="all if left out")
    parser.add_argument("--quick", action="store_true", help="one mistake of a Go2")
    parser.add_argument("--json")
    options = parser.parse_args()
    names = [options.robot] if options.robot else [*ROBOTS]
    mistakes = [options.mistake] if options.mistake else [*MISTAKES]
    if options.quick:
        names, mistakes = names[:1], mistakes[:1]
    rows = [row for name in names for row in rows_of(name, mistakes, 40.0)]
    hand_over(rows, options.json)
