"""Logs: what is read back is what was written, and what is refused is refused in a sentence."""

import re

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import savemat

from jaxid.measurement import units
from jaxid.measurement.chunked_files import open_log_file
from jaxid.measurement.columns import Columns
from jaxid.measurement.recording import read_recording
from jaxid.measurement.units import Quantity, Unit

COLUMNS = Columns(angles="q{}", forces="tau{}", velocities="dq{}", time="t")
FINITE = st.floats(-1e6, 1e6, allow_subnormal=False)


def a_log(joints: int = 2, samples: int = 12) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    log = {"t": 0.004 * np.arange(samples)}
    for group in ("q", "dq", "tau"):
        log |= {f"{group}{j + 1}": rng.normal(size=samples) for j in range(joints)}
    return log


def write_csv(path, log, separator=",", header=True):
    pl.DataFrame(log).write_csv(path, separator=separator, include_header=header)
    return path


def stack(log, group, joints=2):
    return np.stack([log[f"{group}{j + 1}"] for j in range(joints)], axis=1)


def check(recording, log):
    np.testing.assert_array_equal(recording.angles, stack(log, "q"))
    np.testing.assert_array_equal(recording.velocities, stack(log, "dq"))
    np.testing.assert_array_equal(recording.forces, stack(log, "tau"))
    assert recording.sample_time == 0.004
    assert recording.segments == ((0, len(log["t"])),)
    assert recording.notes == ()


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize("header", [True, False])
def test_text_files_of_any_separator(tmp_path, separator, header):
    log = a_log()
    path = write_csv(tmp_path / "log.csv", log, separator, header)
    columns = (
        COLUMNS if header else Columns(angles=(1, 2), velocities=(3, 4), forces=(5, 6), time=0)
    )
    check(read_recording(path, columns), log)


def test_decimal_commas_and_spaces_after_separators(tmp_path):
    log = a_log()
    rows = [
        "; ".join(log),
        *("; ".join(f"{v:.17g}" for v in r) for r in zip(*log.values(), strict=True)),
    ]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(rows).replace(".", ","))
    check(read_recording(path, COLUMNS), log)


def test_savetxt_header(tmp_path):
    log = a_log()
    np.savetxt(tmp_path / "log.txt", np.stack(list(log.values()), 1), header=" ".join(log))
    recording = read_recording(tmp_path / "log.txt", COLUMNS)
    np.testing.assert_allclose(recording.forces, stack(log, "tau"), rtol=1e-15)


@settings(max_examples=25, deadline=None)
@given(data=st.data(), joints=st.integers(1, 4), samples=st.integers(10, 20))
def test_round_trip_of_all_formats(tmp_path_factory, data, joints, samples):
    folder = tmp_path_factory.mktemp("logs")
    q, tau = (data.draw(arrays(np.float64, (samples, joints), elements=FINITE)) for _ in "ab")
    table = {f"q{j + 1}": q[:, j] for j in range(joints)}
    table |= {f"tau{j + 1}": tau[:, j] for j in range(joints)}
    pl.DataFrame(table).write_csv(folder / "a.csv")
    pl.DataFrame(table).write_parquet(folder / "a.parquet")
    np.savez(folder / "a.npz", **table)
    savemat(folder / "a.mat", {"log": table})
    whole = {"q": q, "tau": tau}
    np.savez(folder / "b.npz", **whole)
    savemat(folder / "b.mat", whole)
    pl.DataFrame({k: v.tolist() for k, v in whole.items()}).write_parquet(folder / "b.parquet")
    singles = Columns(angles="q{}", forces="tau{}", sample_time=0.01)
    nested = Columns(angles="log.q{}", forces="log.tau{}", sample_time=0.01)
    arrays_ = Columns(angles="q", forces="tau", sample_time=0.01)
    for file, columns in (
        ("a.csv", singles),
        ("a.parquet", singles),
        ("a.npz", singles),
        ("a.mat", nested),
        ("b.npz", arrays_),
        ("b.mat", arrays_),
        ("b.parquet", arrays_),
    ):
        recording = read_recording(folder / file, columns)
        np.testing.assert_array_equal(recording.angles, q)
        np.testing.assert_array_equal(recording.forces, tau)


def test_units_signs_offsets_and_constants(tmp_path):
    log = a_log()
    path = write_csv(tmp_path / "log.csv", log | {"t": 4000 * np.arange(12)})
    columns = Columns(
        angles="q{}",
        forces="tau{}",
        velocities="dq{}",
        time="t",
        time_unit=units.US,
        angle_unit=(units.MM, units.DEG),
        velocity_unit=(units.MM_PER_S, units.RPM),
        force_unit=units.A,
        torque_constants=(2.0, 0.5),
        angle_signs=(1, -1),
        force_signs=(-1, 1),
        angle_offsets=(0.1, np.pi),
    )
    r = read_recording(path, columns)
    q, dq, tau = (stack(log, g) for g in ("q", "dq", "tau"))
    np.testing.assert_allclose(r.angles[:, 0], 1e-3 * q[:, 0] + 0.1, rtol=1e-14)
    np.testing.assert_allclose(r.angles[:, 1], np.pi - np.deg2rad(q[:, 1]), rtol=1e-14)
    np.testing.assert_allclose(r.velocities[:, 0], 1e-3 * dq[:, 0], rtol=1e-14)
    np.testing.assert_allclose(r.velocities[:, 1], -dq[:, 1] * 2 * np.pi / 60, rtol=1e-14)
    np.testing.assert_allclose(r.forces, tau * [-2.0, 0.5], rtol=1e-14)
    assert r.sample_time == 0.004


def test_velocities_take_the_angles_unit_per_second(tmp_path):
    path = write_csv(tmp_path / "log.csv", a_log())
    columns = Columns(
        angles="q{}", forces="tau{}", velocities="dq{}", time="t", angle_unit=units.DEG
    )
    r = read_recording(path, columns)
    np.testing.assert_allclose(r.velocities, np.deg2rad(stack(a_log(), "dq")), rtol=1e-14)


def test_numbering_from_zero_and_leading_zeros(tmp_path):
    log = a_log()
    renamed = {"t": log["t"]} | {
        f"{g}_{j:02d}": log[f"{g}{j + 1}"] for g in ("q", "tau") for j in range(2)
    }
    path = write_csv(tmp_path / "log.csv", renamed)
    r = read_recording(path, Columns(angles="q_{}", forces="tau_{}", time="t"))
    np.testing.assert_array_equal(r.angles, stack(log, "q"))


def test_nanoseconds_since_1970_keep_their_precision(tmp_path):
    ticks = 1_700_000_000_123_456_789 + 1_000_000 * np.arange(50)
    log = {"t": ticks, "q1": np.arange(50.0), "tau1": np.arange(50.0)}
    for file in ("log.csv", "log.parquet"):
        frame = pl.DataFrame(log)
        frame.write_csv(tmp_path / file) if file == "log.csv" else frame.write_parquet(
            tmp_path / file
        )
        r = read_recording(
            tmp_path / file, Columns(angles="q1", forces="tau1", time="t", time_unit=units.NS)
        )
        assert r.sample_time == 1e-3
        assert r.notes == ()
    dated = pl.DataFrame(log).with_columns(pl.col("t").cast(pl.Datetime("ns")))
    dated.write_parquet(tmp_path / "dated.parquet")
    r = read_recording(tmp_path / "dated.parquet", Columns(angles="q1", forces="tau1", time="t"))
    assert r.sample_time == 1e-3


def test_several_files(tmp_path):
    log = a_log()
    rename = {"q": "Joint_", "tau": "Joint_", "dq": "v"}
    for group, name in rename.items():
        write_csv(tmp_path / f"{group}.csv", {f"{name}{j}": log[f"{group}{j}"] for j in (1, 2)})
    columns = Columns(angles="Joint_{}", forces="Joint_{}", velocities="v{}", sample_time=0.004)
    r = read_recording(
        tmp_path / "q.csv",
        columns,
        "run",
        forces_path=tmp_path / "tau.csv",
        velocities_path=tmp_path / "dq.csv",
    )
    check(r, log)
    assert r.name == "run"


def refused(path, columns, *parts, **kwargs):
    with pytest.raises(ValueError) as caught:
        read_recording(path, columns, **kwargs)
    message = str(caught.value)
    for part in parts:
        assert part in message, message
    assert message.endswith((".", "?")), message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("cell", "complaint"),
    [("", "is empty"), ("abc", "is `abc`, no number"), ("nan", "not"), ("inf", "not finite")],
)
def test_bad_cells_are_named_with_file_column_and_line(tmp_path, cell, complaint):
    rows = ["t,q1,tau1", *(f"{0.01 * i:.2f},{i},{-i}" for i in range(20))]
    rows[8] = f"0.07,{cell},-7"
    (tmp_path / "log.csv").write_text("\n".join(rows))
    columns = Columns(angles="q1", forces="tau1", time="t")
    refused(tmp_path / "log.csv", columns, "`log.csv`", "`q1`", "line 9", complaint)
    ignored = Columns(angles="t", forces="tau1", sample_time=0.01)
    assert read_recording(tmp_path / "log.csv", ignored).samples == 20


def test_bad_rows_of_binary_files(tmp_path):
    q = np.zeros((20, 2))
    q[5, 1] = np.nan
    np.savez(tmp_path / "log.npz", q=q, tau=np.zeros((20, 2)), n=np.array(["a"] * 20))
    columns = Columns(angles="q", forces="tau", sample_time=0.1)
    refused(tmp_path / "log.npz", columns, "`q`", "`log.npz`", "row 6", "not finite (nan)")
    refused(
        tmp_path / "log.npz",
        Columns(angles="n", forces="tau", sample_time=0.1),
        "`n`",
        "real numbers",
    )
    ragged = pl.DataFrame({"q": [[1.0, 2.0]] * 5 + [[1.0]] * 6, "tau": [[1.0, 2.0]] * 11})
    ragged.write_parquet(tmp_path / "log.parquet")
    refused(tmp_path / "log.parquet", columns, "`q`", "row 6", "has 1 numbers")


def test_arrays_of_what_cannot_be_measured(tmp_path):
    """A warning of NumPy would be an error here."""
    columns = Columns("q", "tau", sample_time=0.01)
    both = np.zeros((5, 2))
    both[3] = np.inf, -np.inf
    signal = np.zeros((5, 2), np.float32)
    signal.view(np.uint32)[3, 1] = 0x7F800001
    for array, said in (
        (both, "not finite (nan)"),
        (signal, "not finite (nan)"),
        (np.zeros((5, 0)), "has rows, but no columns"),
    ):
        np.savez(tmp_path / "log.npz", q=array, tau=np.ones((5, 2)))
        refused(tmp_path / "log.npz", columns, "`q`", "`log.npz`", said)


def test_missing_columns_name_the_others_and_the_closest(tmp_path):
    path = write_csv(tmp_path / "log.csv", a_log())
    refused(
        path,
        Columns(angles="q{}", forces="tua{}", time="t"),
        "`log.csv` has no column `tua1` for `forces`",
        "did you mean `tau1`?",
        "`dq2`",
    )
    refused(path, Columns(angles="q{}", forces="tau{}", time="time"), "`time`", "it has `t`")
    refused(path, Columns(angles=(1, 9), forces="tau{}", time="t"), "column 9", "from 0 to 6")
    log = a_log(3)
    del log["q2"]
    path = write_csv(tmp_path / "hole.csv", log)
    refused(path, COLUMNS, "no column `q2`", "though it has `q3`")
    refused(path, Columns(angles=("q1", "q3"), forces="tau{}", time="t"), "3 joints", "have 2")
    path = write_csv(tmp_path / "bare.csv", a_log(), header=False)
    refused(path, COLUMNS, "has no header", "positions from 0 to 6")


def test_damaged_files(tmp_path):
    columns = Columns(angles="q", forces="tau", sample_time=0.1)
    refused(tmp_path / "none.csv", columns, "is no file")
    for name, content in (
        ("log.xlsx", b"x"),
        ("empty.csv", b""),
        ("log.parquet", b"not parquet"),
        ("log.npz", b"not npz"),
        ("log.mat", b"not mat at all" * 30),
    ):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, columns, f"`{name}`")
    (tmp_path / "head.csv").write_text("q,tau\n")
    refused(tmp_path / "head.csv", columns, "`head.csv`")
    (tmp_path / "twice.csv").write_text("q,q,tau\n1,2,3\n")
    refused(tmp_path / "twice.csv", columns, "`q` twice")
    (tmp_path / "ragged.csv").write_text("q,tau\n" + "1,2\n" * 9 + "1,2,3\n" + "1,2\n" * 9)
    refused(tmp_path / "ragged.csv", columns, "`ragged.csv`", "2 columns")
    np.savez(tmp_path / "object.npz", q=np.array([{}]))
    refused(tmp_path / "object.npz", columns, "`object.npz`", "without objects")
    version = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    (tmp_path / "new.mat").write_bytes(version + b"\x00" * 512)
    refused(tmp_path / "new.mat", columns, "7.3", "-v7")


def test_damage_that_polars_takes_for_a_bug_of_its_own(tmp_path, monkeypatch):
    """Its panics are no `Exception`, and depend on which bytes are damaged."""
    path = tmp_path / "log.parquet"
    pl.DataFrame(a_log()).write_parquet(path)
    whole = open_log_file(path, lambda table: tuple(table.columns))

    def panic(*_, **__):
        raise pl.exceptions.PanicException("called `Result::unwrap()` on an `Err` value")

    monkeypatch.setattr(pl, "read_parquet", panic)
    refused(path, COLUMNS, "`log.parquet` is no Parquet file, or is damaged: called")
    monkeypatch.setattr(pl, "scan_parquet", panic)
    with pytest.raises(ValueError, match="or is damaged: called"):
        whole.read(0, 3)


@settings(max_examples=60)
@given(places=st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 255)), max_size=4))
def test_mat_files_with_damaged_bytes(tmp_path_factory, places):
    path = tmp_path_factory.mktemp("mat") / "log.mat"
    t = 0.01 * np.arange(30)
    q = np.sin(np.outer(t, [1.0, 2.0]))
    savemat(path, {"t": t, "q": q, "tau": 3 * q})
    data = bytearray(path.read_bytes())
    for share, byte in places:
        data[int(share * (len(data) - 1))] = byte
    path.write_bytes(data)
    try:
        log = read_recording(path, Columns(angles="q", forces="tau", time="t"))
    except ValueError:
        return
    assert np.isfinite(log.angles).all()
    assert np.isfinite(log.forces).all()


def test_lengths_and_shapes_must_agree(tmp_path):
    log = a_log()
    write_csv(tmp_path / "q.csv", log)
    write_csv(tmp_path / "tau.csv", {k: v[:-1] for k, v in log.items()})
    refused(tmp_path / "q.csv", COLUMNS, "11 samples", "have 12", forces_path=tmp_path / "tau.csv")
    short = {k: v[:8] for k, v in log.items()}
    refused(write_csv(tmp_path / "short.csv", short), COLUMNS, "8 samples", "at least 10")
    np.savez(tmp_path / "lying.npz", t=np.arange(50.0), q=np.zeros((2, 50)), tau=np.zeros((2, 50)))
    refused(
        tmp_path / "lying.npz",
        Columns(angles="q", forces="tau", time="t"),
        "50 stamps for 2 samples",
        "transpose",
    )
    columns = Columns(angles="q{}", forces="tau{}", time="t")
    refused(
        tmp_path / "q.csv",
        columns,
        "`Columns.velocities` names no columns",
        velocities_path=tmp_path / "tau.csv",
    )
    wrong = Columns(angles="q{}", forces="tau{}", time="t", angle_offsets=(1.0,))
    refused(tmp_path / "q.csv", wrong, "`angle_offsets`", "(2)")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"time": None}, "either `time`"),
        ({"sample_time": 0.1}, "both"),
        ({"time": None, "sample_time": -1.0}, "`sample_time` must be positive"),
        ({"angle_unit": units.NM}, "`angle_unit` must measure an angle or a length, but `N m`"),
        ({"time_unit": units.DEG}, "`time_unit`"),
        ({"force_unit": units.A}, "`torque_constants` [N m/A] are needed"),
        ({"torque_constants": (1.0,)}, "leave them out"),
        ({"angle_signs": (2,)}, "`angle_signs` must be +1 or -1"),
    ],
)
def test_columns_that_contradict_themselves(change, complaint):
    with pytest.raises(ValueError, match=re.escape(complaint)):
        Columns(**({"angles": "q{}", "forces": "tau{}", "time": "t"} | change))


def test_units_by_symbol():
    assert all(units.unit(known.symbol) is known for known in units.ALL)
    for wrong, near in (("degrees", "deg"), ("rads/s", "rad/s"), ("Nm", "N m")):
        with pytest.raises(
            ValueError, match=rf"`{wrong}` is no known unit \(did you mean `{near}`"
        ):
            units.unit(wrong)
    with pytest.raises(ValueError, match="`factor`"):
        Unit("nothing", 0.0, Quantity.FORCE)


def test_measured_robots(shared_data):
    tx40 = read_recording(
        shared_data / "tx40" / "motor_position.csv",
        Columns(angles="Joint_{}", forces="Joint_{}", sample_time=2e-4),
        "TX40",
        forces_path=shared_data / "tx40" / "motor_torque.csv",
    )
    assert tx40.angles.shape == (45000, 6)
    assert tx40.duration == pytest.approx(9.0)
    assert tx40.angles[0, 2] == -70.685
    assert tx40.forces[1, 1] == -0.84434
    ur10 = read_recording(shared_data / "ur10" / "exciting_measured.csv", COLUMNS)
    assert ur10.angles.shape == (3441, 6)
    assert ur10.sample_time == 0.008
    for name in "ABC":
        kr300 = read_recording(
            shared_data / "kr300" / f"traj_{name}.csv",
            Columns(angles="q_mot{}", forces="tau_motor{}", velocities="dq_mot{}", time="t"),
        )
        assert kr300.angles.shape == (2501, 6)
        assert kr300.sample_time == 0.004
        assert kr300.notes == ()


def test_whole_numbers_beyond_64_bits_are_read_part_by_part(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("q1,tau1\n" + "18446744073709551616,1\n" * 30)
    file = open_log_file(path, lambda table: tuple(table.columns))
    found = file.read(0, 30).array("angles", "q1")
    np.testing.assert_array_equal(found, np.full((30, 1), 2.0**64))


def test_a_column_with_a_huge_number_costs_no_memory(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q1674407370955165,q2,tau1,tau2\n" + "0,1,2,3,4\n" * 30)
    refused(path, Columns("q{}", "tau{}", time="t"), "has no column `q1`")
