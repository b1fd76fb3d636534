"""Inverse dynamics of robots from public files, against Pinocchio and MuJoCo.

    python benchmarks/robot_files.py [--quick] [--json FILE] [--all] [FOLDER ...]

Reads every URDF and MJCF file below some folders, by default those of the package
`example-robot-data`, and computes forces at random states with the inertias, rotors,
friction and springs that the file claims. Pinocchio computes the same for a URDF,
MuJoCo for an MJCF file, with all its passive forces. Errors are relative to the
largest force of the joint, and at least to 1e-4 of that of the robot. A result is

* right: the error is at most 1e-10;
* noted: it is, once the peer leaves out the elements that a note of the robot names;
* refused: one sentence says why, and its cure does not help. Cures are tried literally:
  the `base` that it names, a `tip`, a change of the file;
* without a word: anything else, which must not happen.

Files that the peer cannot read, copies of other files, and files without a moving joint
are counted, but not compared. `--all` also prints the sentences and notes. Packages
with many such files are listed in `README.md`; unpack them, and give their folders.
"""

import hashlib
import os
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import timing
from lxml import etree
from robot_peers import open_peer
from timing import Row, hand_over

SHARE = "cmeel.prefix/share/example-robot-data/robots"
TOLERANCE = 1e-10
SAMPLES = 3
MIN_FORCE_SHARE = 1e-4
"""Forces of a joint count relative to at least this share of the robot's largest."""
CORRECTIONS = ("cannot belong to a real body", "by rounding")
"""Words of notes on moments of inertia that the package corrects."""
MAX_TIPS = 20
"""Number of links that are tried as `tip` where a file is refused."""


class Result(NamedTuple):
    """Result of one file.

    Attributes:
        file: Path of the file below its folder.
        kind: "right", "noted", "refused", "without a word", or why it is not compared.
        joints: Number of joints.
        error: Relative error of the forces.
        words: Sentences of the package.
        cure: What was done where the file was refused first.
    """

    file: str
    kind: str
    joints: int = 0
    error: float = np.nan
    words: tuple[str, ...] = ()
    cure: str = ""


def robot_files(folder: Path) -> Iterator[Path]:
    """Yield the URDF and MJCF files below a folder."""
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".urdf":
            yield path
        elif path.suffix in (".xml", ".mjcf"):
            text = path.read_text(encoding="utf-8", errors="replace")
            if "<mujoco" in text and "<worldbody" in text:
                yield path


def relative_error(forces: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest error, relative to the largest forces."""
    sizes = np.abs(expected).max(axis=0)
    sizes = np.maximum(sizes, MIN_FORCE_SHARE * sizes.max())
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    errors = np.abs(forces - expected) / sizes
    return float(errors.max())


def claimed_forces(jid: Any, path: Path, robot: Any, motion: Any, chain: dict):
    """Return the forces of what a file claims, and whether its bodies can exist."""
    terms = (*jid.Model(robot).terms, jid.terms.LinearSpring(), jid.ConstantOffset())
    model = jid.Model(robot, terms)
    file = jid.workflow.RobotFile(str(path), **chain)
    claims = file.claims()
    p = np.array([claims.get(name, 0.0) for name in model.parameter_names])
    bodies = jid.robots.urdf_parameters(str(path), check=False, **chain)
    is_possible = np.allclose(p[: len(bodies)], bodies, rtol=1e-12, atol=0.0)
    # Notes name bodies that cannot exist; the others are compared with all digits.
    p[: len(bodies)] = bodies
    return np.asarray(model.inverse_dynamics(p, motion)), is_possible


def random_motion(jid: Any, joints: int) -> Any:
    """Return a motion in which no joint is slow.

    Then dry friction has its whole size in all programs.
    """
    random = np.random.default_rng(0)
    shape = (SAMPLES, joints)
    q = random.uniform(-1.0, 1.0, shape)
    qd = random.choice([-1.0, 1.0], shape) * random.uniform(0.5, 1.0, shape)
    qdd = random.uniform(-5.0, 5.0, shape)
    return jid.Motion(q, qd, qdd)


def compare(jid: Any, path: Path, name: str, chain: dict) -> Result:
    """Compare a file with the peer; raise the package's error if it is refused."""
    robot = jid.load_urdf(str(path), **chain)
    motion = random_motion(jid, robot.joints)
    forces, is_possible = claimed_forces(jid, path, robot, motion, chain)
    words = " ".join(robot.notes)

    cases = [("right", (), False), ("noted", robot.notes, False)]
    if "held at" in words:
        cases.append(("noted", robot.notes, True))
    kind = "without a word"
    error = np.inf
    for case, notes, hold in cases:
        peer = open_peer(path)
        peer.keep_chain(chain.get("base"), chain.get("tip"))
        peer.leave_out(notes)
        error = relative_error(forces, peer.forces(robot.joint_names, motion, hold))
        if error <= TOLERANCE:
            kind = case
            break
    if not is_possible and kind == "right":
        kind = "noted" if any(x in words for x in CORRECTIONS) else "without a word"
    return Result(name, kind, robot.joints, error, robot.notes)


def exchange_ends(root: Any) -> None:
    """Exchange the ends of ranges whose lower end is above the upper one."""
    for limit in root.iter("limit"):
        low = limit.get("lower")
        high = limit.get("upper")
        if low is not None and high is not None and float(low) > float(high):
            limit.set("lower", high)
            limit.set("upper", low)


def remove_couplings(root: Any) -> None:
    """Remove constraints by which joints follow others."""
    for element in list(root.xpath("//mimic | //equality/joint")):
        element.getparent().remove(element)


def remove_balls(root: Any) -> None:
    """Remove ball joints of an MJCF file."""
    for element in list(root.xpath("//joint[@type='ball'] | //ball")):
        element.getparent().remove(element)


EDITS = {
    "exchange the ends": exchange_ends,
    "remove the constraint": remove_couplings,
    "remove it, which fixes its body": remove_balls,
}
"""Changes of a file that sentences propose."""


def cures(path: Path, chain: dict, sentence: str) -> Iterator[tuple[Path, dict]]:
    """Yield files and ends of chains that a sentence proposes.

    A changed file lies beside the first one, whose meshes it needs, while it is used.
    """
    for base in re.findall(r"--base (.+?)`", sentence):
        yield path, chain | {"base": base}
    for words, edit in EDITS.items():
        if words in sentence:
            parser = etree.XMLParser(recover=True)
            root = etree.fromstring(path.read_bytes(), parser)
            edit(root)
            copy = path.with_name(f"{path.stem}-cured{path.suffix}")
            copy.write_bytes(etree.tostring(root))
            try:
                yield copy, chain
            finally:
                copy.unlink()
    if "`tip`" in sentence and "tip" not in chain:
        for tip in open_peer(path).links()[:MAX_TIPS]:
            yield path, chain | {"tip": tip}


def cured_result(
    jid: Any, path: Path, name: str, chain: dict, sentence: str
) -> Result | None:
    """Return the result of the first cure that works; None if none does."""
    for cured_path, cured_chain in cures(path, chain, sentence):
        try:
            found = compare(jid, cured_path, name, cured_chain)
        except jid.InputError as error:
            # The first sentence may lead to a second one with a cure of its own.
            is_step = cured_path != path or "tip" not in cured_chain
            if not is_step or str(error) == sentence:
                continue
            found = cured_result(jid, cured_path, name, cured_chain, str(error))
            if found is None:
                continue
        cure = found.cure or str(cured_chain)
        if cured_path != path:
            cure = "the file changed as the sentence says"
        return found._replace(words=(sentence, *found.words), cure=cure)
    return None


def result(jid: Any, path: Path, name: str) -> Result:
    """Return the result of a file, or that of the first cure which works."""
    unreadable = ""
    try:
        open_peer(path)
    except Exception as error:  # every program has errors of its own
        unreadable = str(error)
    try:
        if unreadable:
            jid.load_urdf(str(path))
            return Result(name, "not readable by the peer", words=(unreadable,))
        return compare(jid, path, name, {})
    except jid.InputError as error:
        sentence = str(error)
    if unreadable:
        return Result(name, "not readable by the peer", words=(unreadable, sentence))
    if "no moving joint" in sentence:
        return Result(name, "without a moving joint")
    refusal = Result(name, "refused", words=(sentence,))
    return cured_result(jid, path, name, {}, sentence) or refusal


def results(jid: Any, folders: list[Path]) -> Iterator[Result]:
    """Yield the results of all files below some folders."""
    contents = set()
    for folder in folders:
        for path in robot_files(folder):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            name = f"{folder.name}/{path.relative_to(folder)}"
            if digest in contents:
                yield Result(name, "copy of another file")
                continue
            contents.add(digest)
            yield result(jid, path, name)


def example_folder() -> Path:
    """Return the folder of the robots of `example-robot-data`."""
    return Path(str(distribution("example-robot-data").locate_file(SHARE)))


def main():
    """Print the results of all files, and the row."""
    parser = timing.parser(__doc__, "the first ten files")
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--all", action="store_true", help="print sentences, too")
    given = parser.parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxid as jid

    kinds: Counter[str] = Counter()
    cured = 0
    folders = [folder.resolve() for folder in given.folders]
    os.chdir(tempfile.mkdtemp())  # MuJoCo writes its warnings to a file
    for found in results(jid, folders or [example_folder()]):
        jax.clear_caches()  # the programs of this robot
        kinds[found.kind] += 1
        if found.kind in ("copy of another file", "without a moving joint"):
            continue
        cured += bool(found.cure)
        print(
            f"{found.file}: {found.kind}, {found.joints} joints, {found.error:.1e} "
            f"{found.cure}",
            flush=True,
        )
        if given.all or found.kind in ("refused", "without a word"):
            for sentence in found.words:
                print(f"    {sentence}", flush=True)
        if given.quick and sum(kinds.values()) >= 10:
            break
    measured = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    row = Row(
        "robot files",
        "dynamics of public URDF and MJCF files, against Pinocchio and MuJoCo",
        f"`benchmarks/robot_files.py`; {cured} by the cure in the refusal",
        "0 without a word",
        measured,
        kinds["without a word"] == 0,
    )
    hand_over([row], given.json)


if __name__ == "__main__":
    main()
