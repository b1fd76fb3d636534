"""Designs for five arms by the command with its default settings, judged by MuJoCo.

    python benchmarks/safe_motions.py [panda ur5 xarm7 z1 kinova] [--time 60] [--more
        240] [--quick]

The descriptions are those of the package `example-robot-data`, two of them with a
gripper. For each arm `jaxid init ARM.URDF` and `jaxid excite --time 60` run as a user
runs them. Then MuJoCo, which shares no code with this package, judges 4001 instants of
the whole motion, leads included: links as the convex hulls of their meshes, the plane z
= 0 of the base as the floor, positions and speeds against the limits of the URDF,
inverse dynamics with the URDF's inertias, damping and friction against its efforts.
Links that a joint connects, and pairs that touch in each of 1000 random poses, count
neither here nor there.

The search has one thread. Its seconds are counted by the processor's time, so that
other programs on the machine do not matter: they are those of an idle machine.

* first: time from the start of the command to the first motion that keeps all limits,
  in seconds of the clock and of the processor (other programs may share the cores).
* floor, self: smallest distance of a link from the floor and from another link; inf
  above 200 mm.
* position: smallest distance from an end of a range; speed, use: largest speed and
  force of all joints over the URDF's velocity and effort.
* D: geometric mean of the parameters' standard deviations after `--time` over that of
  the longest search, which goes on for `--more` seconds; below 1 the longer search has
  found nothing better.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import jax
import mujoco
import numpy as np
import timing
import trimesh

import jaxid as jid

jax.config.update("jax_enable_x64", True)
ROBOTS = "lib/python*/site-packages/cmeel.prefix/share/example-robot-data/robots"
ARMS = {
    "panda": "panda_description/urdf/panda.urdf",
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "z1": "z1_description/urdf/z1.urdf",
    "kinova": "kinova_description/robots/kinova.urdf",
}
INSTANTS, POSES, NEAR = 4001, 1000, 0.1
"""Instants of a motion, random poses, and MuJoCo's largest distance [m]."""
JAXID = [sys.executable, "-m", "jaxid"]
TICKS = os.sysconf("SC_CLK_TCK")


def robots() -> Path:
    return next(Path(sys.prefix).glob(ROBOTS))


def design(folder: Path, seconds: float, *more: str) -> dict[str, float]:
    """Run the command with output to a file; return when the first motion came."""
    # As `python -m jaxid`, but the command counts its own seconds of the processor.
    begin = (
        "import runpy, time; time.monotonic = time.process_time; "
        "runpy.run_module('jaxid', run_name='__main__')"
    )
    command = [
        sys.executable,
        "-c",
        begin,
        "excite",
        "experiment.toml",
        "-o",
        "motion.csv",
    ]
    command += ["--time", f"{seconds:g}"]
    first, start = {}, time.monotonic()
    with (folder / "output.txt").open("w") as output:
        process = subprocess.Popen(
            [*command, *more], cwd=folder, stdout=output, stderr=subprocess.STDOUT
        )
        while process.poll() is None:
            if not first and (folder / "motion.json").exists():
                shutil.copy(folder / "motion.json", folder / "first.json")
                first = {
                    "first": time.monotonic() - start,
                    "first CPU": cpu(process.pid),
                }
            used = cpu(process.pid)
            time.sleep(0.05)
    found = first | {
        "wall": time.monotonic() - start,
        "CPU": used,
        "code": process.returncode,
    }
    return found


def cpu(pid: int) -> float:
    """Return the processor's seconds of a process that may have ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return np.nan
    return (int(fields[11]) + int(fields[12])) / TICKS


class Oracle:
    """A robot in MuJoCo, whose meshes are converted, above a floor."""

    def __init__(self, urdf: Path, folder: Path):
        spec = mujoco.MjSpec.from_file(str(readable(urdf, folder)))
        floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE)
        floor.size = [5.0, 5.0, 0.1]
        self.model = spec.compile()
        self.model.geom_margin[:] = NEAR
        self.data = mujoco.MjData(self.model)
        joints = ET.parse(urdf).getroot().findall("joint")
        self.limits = {j.get("name"): j.find("limit") for j in joints}
        rng, model = np.random.default_rng(0), self.model
        low, high = model.jnt_range.T
        free = ~model.jnt_limited.astype(bool)
        low, high = np.where(free, -np.pi, low), np.where(free, np.pi, high)
        touching = [self.touching(rng.uniform(low, high)) for _ in range(POSES)]
        self.always = set.intersection(*touching)

    def touching(self, q) -> set[tuple[int, int]]:
        """Return pairs of bodies that touch in a pose."""
        return {pair for pair, gap in self.gaps(q) if gap <= 0}

    def gaps(self, q):
        """Return pairs of near bodies (the floor is -1), and their distances [m]."""
        data, model = self.data, self.model
        data.qpos[:] = q
        mujoco.mj_fwdPosition(model, data)
        found = []
        for contact in data.contact[: data.ncon]:
            geoms = [int(g) for g in contact.geom]
            floor = model.geom("floor").id
            bodies = [-1 if g == floor else int(model.geom_bodyid[g]) for g in geoms]
            pair = tuple(sorted(bodies))
            parents = [None if b < 0 else int(model.body_parentid[b]) for b in pair]
            fixed = pair == (-1, 0)
            if not fixed and pair[0] != parents[1]:
                found.append((pair, float(contact.dist)))
        return found

    def forces(self, q, qd, qdd) -> np.ndarray:
        """Return the inverse dynamics' forces, and the largest dry friction [N m]."""
        model, data, flags = self.model, self.data, self.model.opt.disableflags
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        model.opt.disableflags = flags
        return np.abs(data.qfrc_inverse) + model.dof_frictionloss

    def judge(self, names, motion) -> dict[str, float]:
        """Return margins of a motion of some joints; the others stand at zero."""
        at = [self.model.joint(name).qposadr[0] for name in names]
        q, qd, qdd = (np.zeros((len(motion.q), self.model.nq)) for _ in range(3))
        for values, own in ((q, motion.q), (qd, motion.qd), (qdd, motion.qdd)):
            values[:, at] = own
        gap, use = {"floor": (np.inf, ()), "self": (np.inf, ())}, 0.0
        efforts = np.array([float(self.limits[n].get("effort")) for n in names])
        for k in range(len(q)):
            for pair, distance in self.gaps(q[k]):
                if pair not in self.always:
                    kind = "floor" if pair[0] < 0 else "self"
                    gap[kind] = min(gap[kind], (distance, pair))
            use = max(use, (self.forces(q[k], qd[k], qdd[k])[at] / efforts).max())
        speeds = np.array([float(self.limits[n].get("velocity")) for n in names])
        ranges = [self.model.joint(n).range for n in names]
        limited = [bool(self.model.joint(n).limited[0]) for n in names]
        inside = [
            min((x - low).min(), (high - x).min()) if known else np.inf
            for x, (low, high), known in zip(q[:, at].T, ranges, limited, strict=True)
        ]
        return {
            **{f"{kind} [mm]": 1e3 * least for kind, (least, _) in gap.items()},
            "nearest": [self.model.body(max(b, 0)).name for b in gap["self"][1]],
            "position": min(inside),
            "speed [%]": 100 * float((np.abs(qd[:, at]) / speeds).max()),
            "use [%]": 100 * float(use),
        }


def readable(urdf: Path, folder: Path) -> Path:
    """Return a copy of a URDF without what is only drawn, whose meshes MuJoCo reads."""
    tree = ET.parse(urdf)
    root = tree.getroot()
    compiler = ET.SubElement(ET.SubElement(root, "mujoco"), "compiler")
    compiler.attrib |= {
        "meshdir": str(folder),
        "balanceinertia": "true",
        "discardvisual": "true",
    }
    for link in root.iter("link"):
        drawn = link.findall("visual")
        for visual in drawn:
            if link.find("collision") is None:
                visual.tag = "collision"
            else:
                link.remove(visual)
        for number, mesh in enumerate(link.iter("mesh")):
            path = mesh.get("filename").partition("://")[2]
            source = next(
                p
                for p in (
                    robots().parent.parent / path,
                    robots() / path.partition("robots/")[2],
                )
                if p.is_file()
            )
            name = f"{link.get('name')}_{number}.stl"
            trimesh.load(source, force="mesh").export(folder / name)
            mesh.set("filename", name)
    tree.write(folder / "oracle.urdf")
    return folder / "oracle.urdf"


def log_deviation(experiment, trajectory) -> float:
    """Return the logarithm of the geometric mean of all standard deviations."""
    noise = 0.01 * np.asarray(experiment.setup.robot.max_forces)
    motion = trajectory.motion(np.asarray(trajectory.basis.times(800)))
    theta = np.asarray(experiment.setup.base.regressor(motion)) / noise[:, None]
    sizes = np.abs(
        np.linalg.qr(theta.reshape(-1, experiment.setup.base.size), mode="r").diagonal()
    )
    return -float(np.mean(np.log(sizes)))


def main():
    """Design for the arms, judge, go on, compare."""
    parser = timing.parser(__doc__, "one arm, for ten seconds")
    parser.add_argument("arms", nargs="*", default=[*ARMS])
    parser.add_argument("--time", type=float, default=60.0)
    parser.add_argument("--more", type=float, default=240.0)
    options = parser.parse_args()
    if options.quick:
        options.arms, options.time, options.more = ["ur5"], 10.0, 0.0
    os.environ["PYTHONPATH"] = str(timing.REPOSITORY)
    clear = 0
    for arm in options.arms:
        urdf = robots() / ARMS[arm]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            text = subprocess.run(
                [*JAXID, "init", urdf], capture_output=True, check=True, cwd=name
            )
            (folder / "experiment.toml").write_bytes(text.stdout)
            found = design(folder, options.time)
            experiment = jid.experiment.load_experiment(folder / "experiment.toml")
            trajectory = jid.trajectories.load_trajectory(folder / "motion.json")
            motion = trajectory.motion(
                np.linspace(0.0, float(trajectory.duration), INSTANTS)
            )
            margins = Oracle(urdf, folder).judge(
                experiment.setup.robot.joint_names, motion
            )
            good = (
                min(
                    margins["floor [mm]"],
                    margins["self [mm]"],
                    margins["position"] + 1e-9,
                )
                > 0
            )
            good &= max(margins["speed [%]"], margins["use [%]"]) <= 100 + 1e-6
            clear += good
            figures = found | margins
            if options.more:
                begin = log_deviation(experiment, trajectory)
                design(folder, options.more, "--resume")
                trajectory = jid.trajectories.load_trajectory(folder / "motion.json")
                figures["D"] = np.exp(begin - log_deviation(experiment, trajectory))
            words = ", ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                for key, value in figures.items()
            )
            print(f"{arm}: {'clear' if good else 'NOT CLEAR'}; {words}", flush=True)
    print(f"{clear} of {len(options.arms)} motions are clear")


if __name__ == "__main__":
    main()
