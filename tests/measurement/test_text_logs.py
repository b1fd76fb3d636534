"""Text logs of many programs: each gives the samples of the plain table."""

import numpy as np
import pytest

from jaxid import units
from jaxid.errors import InputError
from jaxid.measurement.columns import Columns
from jaxid.measurement.reading import read_recording

COLUMNS = Columns(angles="q{}", forces="tau{}", time="time")
SAMPLES = 30
TIMES = 0.02 * np.arange(SAMPLES)
NAMES = ["time", "q1", "q2", "tau1", "tau2"]


def numbers():
    rng = np.random.default_rng(3)
    values = np.round(rng.normal(size=(SAMPLES, 4)), 6)
    return np.column_stack([np.round(TIMES, 3), values])


def rows():
    return [[f"{x:.6f}" for x in row] for row in numbers()]


def table(separator=",", ending="\n", cells=None, names=NAMES, end=""):
    lines = [names, *(rows() if cells is None else cells)]
    return ending.join(separator.join(line) + end for line in lines) + ending


def stamped(stamps):
    cells = [[stamp, *row[1:]] for stamp, row in zip(stamps, rows(), strict=True)]
    return table(cells=cells)


def commas(cells):
    return [[cell.replace(".", ",") for cell in row] for row in cells]


def quoted(cells):
    return [[f'"{cell}"' for cell in row] for row in cells]


def under_header(text, *lines):
    header, _, rest = text.partition("\n")
    return "\n".join([header, *lines, rest])


LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\n"
    "Date\t2026/01/05\nX0\t0.000E+0\t0.0\nDelta_X\t0.02\t0.02\n***End_of_Header***\n\n"
)
CLOCK = [f"13:27:{15 + t:06.3f}" for t in TIMES]
MIDNIGHT = [f"23:59:{59.8 + t:06.3f}" for t in TIMES[:10]] + [
    f"00:00:{t - 0.2:06.3f}" for t in TIMES[10:]
]

LINES = table().splitlines(keepends=True)


def with_lines(text, *places):
    """Insert a line before some lines of the table."""
    lines = [*LINES]
    for place in sorted(places, reverse=True):
        lines.insert(place, f"{text}\n")
    return "".join(lines)


AUTUMN = [f"2026-10-25T03:00:{59 + t:09.6f}+02:00" for t in TIMES[:10]] + [
    f"2026-10-25T02:00:{59 + t:09.6f}+01:00" for t in TIMES[10:]
]
VARIANTS = {
    "comments": "# recorded 2026-01-05 by rig 3\n# firmware 5.2, 50 Hz\n" + table(),
    "comment with the names": "# q1, q2, tau1, tau2 over time of the arm\n" + table(),
    "percent and title": "% rig 3\nMy log;second cell\n\n" + table(";"),
    "comments before a commented header": "# rig 3\n# " + table(),
    "title with the names": "time of q1 q2 tau1 tau2\n" + table(),
    "byte order mark": "\ufeff# rig\n" + table(),
    "quoted title": '"rig, hall 3",,,,\n' + table(),
    "LabVIEW": LABVIEW + table("\t", end="\t"),
    "LabVIEW with commas": LABVIEW + table("\t", cells=commas(rows())),
    "LabVIEW without comments": LABVIEW + table("\t", names=[*NAMES, "Comment"]),
    "units": under_header(table(), "s,rad,rad,N m,N m"),
    "units in comments": under_header(table(), "# [s],[rad],[rad],[N m],[N m]", ""),
    "separators behind all": table(end=","),
    "semicolons behind all": table(";", end=";;"),
    "separators behind the header": table(end=",").replace(",\n", "\n").replace(
        "tau2\n", "tau2,\n", 1
    ),
    "separators behind the rows": table(end=",").replace("tau2,\n", "tau2\n", 1),
    "separators behind some rows": table(end=",").replace("7,\n", "7\n"),
    "tabs behind the rows": table("\t", end="\t").replace("tau2\t\n", "tau2\n", 1),
    "two columns without a name": table(
        names=[*NAMES, "", ""], cells=[[*row, "x", "1"] for row in rows()]
    ),
    "index without a name": table(
        names=["", *NAMES], cells=[[str(k), *row] for k, row in enumerate(rows())]
    ),
    "repeated columns": table(
        names=[*NAMES, "gain", "gain"], cells=[[*row, "1", "?"] for row in rows()]
    ),
    "texts": table(
        names=["state", *NAMES], cells=[['"run, fast"', *row] for row in rows()]
    ),
    "decimal commas and tabs": table("\t", cells=commas(rows())),
    "decimal commas and spaces": table("  ", cells=commas(rows())),
    "decimal commas in quotes": table(cells=quoted(commas(rows()))),
    "all in quotes": table(cells=quoted(rows()), names=[f'"{n}"' for n in NAMES]),
    "carriage returns": table(ending="\r"),
    "Windows": table(ending="\r\n"),
    "Windows twice": table(ending="\r\r\n"),
    "ISO": stamped([f"2026-01-05T13:27:{15 + t:09.6f}" for t in TIMES]),
    "ISO with a zone": stamped([f"2026-01-05 {clock}000+01:00" for clock in CLOCK]),
    "ISO in UTC": stamped([f"2026-01-05T{clock}Z" for clock in CLOCK]),
    "slashes": stamped([f"2026/01/05 {clock}" for clock in CLOCK]),
    "clock": stamped(CLOCK),
    "midnight": stamped(MIDNIGHT),
    "durations": stamped([f"0 days 00:00:{t:09.6f}" for t in TIMES]),
    "change of the zone": stamped(AUTUMN),
    "west of Greenwich": stamped([x.replace("+", "-") for x in AUTUMN[:10]] + [
        x.replace("02:00:", "04:00:").replace("+01", "-01") for x in AUTUMN[10:]
    ]),
    "minutes and seconds of Excel": stamped([f"59:{59 + t:06.3f}" for t in TIMES]),
    "the next hour": stamped([f"59:{59.8 + t:06.3f}" for t in TIMES[:10]] + [
        f"00:{t - 0.2:06.3f}" for t in TIMES[10:]
    ]),
    "marks between the rows": with_lines("# mark", 5, 12, 13, 30),
    "comments between the rows": with_lines("// next, please", 5, 12),
    "events between the rows": with_lines("Event: operator waits", 3, 9),
    "comments at the end": table() + "# end\n% of the log\n",
    "title at the end": table() + "End of file\n",
    "ISO at midnight": stamped(
        [f"2026-01-{5 + (k > 9):02d}T{c}" for k, c in enumerate(MIDNIGHT)]
    ),
}  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_tables_of_many_programs_give_the_same_samples(tmp_path, variant):
    path = tmp_path / "log.csv"
    path.write_bytes(VARIANTS[variant].encode())
    recording = read_recording(path, COLUMNS)
    assert not any("row" in note for note in recording.notes if "first row" not in note)
    values = numbers()
    np.testing.assert_allclose(recording.angles, values[:, 1:3], rtol=1e-14)
    np.testing.assert_allclose(recording.forces, values[:, 3:], rtol=1e-14)
    assert recording.sample_time == pytest.approx(0.02, rel=1e-9)
    assert len(recording.segments) == 1


def test_comments_between_rows_without_stamps_leave_no_gap(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(with_lines("# mark", 5, 12))
    columns = Columns(angles="q{}", forces="tau{}", sample_time=0.02)
    recording = read_recording(path, columns)
    np.testing.assert_allclose(recording.time, TIMES, atol=1e-12)
    np.testing.assert_array_equal(recording.angles, numbers()[:, 1:3])
    assert recording.notes == ()


@pytest.mark.parametrize("end", ["mean,0,0,0,0\nmax,1,1,2,2\n", "samples,30\n"])
def test_a_summary_at_the_end_is_left_out_and_named(tmp_path, end):
    path = tmp_path / "log.csv"
    path.write_text(table() + end)
    recording = read_recording(path, COLUMNS)
    np.testing.assert_array_equal(recording.angles, numbers()[:, 1:3])
    assert "line 32" in recording.notes[0]
    path.write_text(table() + "nan,nan,nan,nan,nan\n" * 6)
    with pytest.raises(ValueError, match="of 36 rows are bad"):
        read_recording(path, COLUMNS)


def test_western_encodings_of_windows(tmp_path):
    path = tmp_path / "log.csv"
    names = ["Zeit [s]", "q1 [°]", "q2 [°]", "tau1 [µNm]", "tau2 [µNm]"]
    path.write_bytes(table(names=names).encode("cp1252"))
    columns = Columns("q{} [°]", "tau{} [µNm]", time="Zeit [s]")
    recording = read_recording(path, columns)
    np.testing.assert_array_equal(recording.angles, numbers()[:, 1:3])
    with pytest.raises(ValueError, match=r"closest first: `q1 \[°\]`"):
        read_recording(path, Columns("q{} [deg]", "tau{}", time="Zeit [s]"))


def test_days_of_matlab(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(stamped([f"{739_000.5 + t / 86400:.11f}" for t in TIMES]))
    columns = Columns(angles="q{}", forces="tau{}", time="time", time_unit=units.DAY)
    recording = read_recording(path, columns)
    assert recording.sample_time == pytest.approx(0.02, rel=1e-3)
    np.testing.assert_array_equal(recording.angles, numbers()[:, 1:3])


@pytest.mark.parametrize("commented", ["", "# rig 3\n#\n"])
@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("separator", [",", "\t", ";", " "])
def test_positions_need_no_header(tmp_path, commented, named, separator):
    text = table(separator)
    path = tmp_path / "log.csv"
    path.write_text(commented + (text if named else text.partition("\n")[2]))
    columns = Columns(angles=(1, 2), forces=(3, 4), time=0)
    recording = read_recording(path, columns)
    np.testing.assert_array_equal(recording.forces, numbers()[:, 3:])


def test_wanted_columns_that_are_repeated_or_missing_are_named(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(table(names=["time", "q1", "q1", "tau1", "tau2"]))
    with pytest.raises(ValueError, match=r"`q1` twice.* positions"):
        read_recording(path, COLUMNS)
    columns = Columns(angles=(1, 2), forces=(3, 4), time="time")
    np.testing.assert_array_equal(
        read_recording(path, columns).angles, numbers()[:, 1:3]
    )
    path.write_text("# rig 3, hall 2\n" + table())
    with pytest.raises(ValueError, match="closest first: `q1`"):
        read_recording(path, Columns(angles="qq{}", forces="tau{}", time="time"))


def test_lines_are_numbered_as_in_the_file(tmp_path):
    cells = rows()
    cells[4][1] = "oops"
    text = "# rig\n\n" + under_header(table(cells=cells), "s,rad,rad,N m,N m")
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(ValueError, match=r"line 9 \(`q1` is `oops`"):
        read_recording(tmp_path / "log.csv", COLUMNS)
    stamps = [*CLOCK]
    stamps[7] = "noon"
    (tmp_path / "log.csv").write_text(stamped(stamps))
    with pytest.raises(
        ValueError, match=r"line 9 \(`time` is `noon`, neither a number"
    ):
        read_recording(tmp_path / "log.csv", COLUMNS)
    recording = read_recording(tmp_path / "log.csv", COLUMNS, bad_rows=0.1)
    assert recording.samples == SAMPLES - 1


def test_numbers_of_fortran_and_of_spreadsheets(tmp_path):
    rng = np.random.default_rng(1)
    forces = np.round(1e3 * rng.normal(size=(SAMPLES, 2)), 1)
    lines = ["time,q1,tau1"]
    for t, (q, force) in zip(TIMES, forces, strict=True):
        exponent = f"{q:.6E}".replace("E", "D")
        lines.append(f'{t:.3f},{exponent},"{force:,.1f}"')
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines))
    log = read_recording(path, COLUMNS)
    np.testing.assert_allclose(log.angles[:, 0], forces[:, 0])
    np.testing.assert_allclose(log.forces[:, 0], forces[:, 1])


@pytest.mark.parametrize(
    ("channel", "size", "start"),
    [
        ("angles", 2**16, 65000),
        ("angles", 2**16, -20),
        ("forces", 2**16, -30),
        ("velocities", 2**16, -300),
    ],
)
def test_counters_that_begin_again_go_on(tmp_path, channel, size, start):
    """Also numbers whose sign was lost; others of the same size stay as they are."""
    counts = start + np.cumsum(np.arange(SAMPLES) * (9 if start > 0 else 1))
    columns = dict.fromkeys(("angles", "forces", "velocities"), np.arange(SAMPLES))
    columns[channel] = counts % size
    path = tmp_path / "log.csv"
    rows = [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]))
    names = {name: name for name in columns}
    log = read_recording(path, Columns(**names, sample_time=0.01))
    steps = np.diff(getattr(log, channel)[:, 0])
    np.testing.assert_array_equal(steps, np.diff(counts))
    assert f"`{channel}` jump by {size}" in log.notes[0]
    assert len(log.notes) == 1
    if start < 0:
        np.testing.assert_array_equal(getattr(log, channel)[:, 0], counts)


def test_a_text_that_is_no_table_is_refused_at_once(tmp_path):
    rows = "\n".join(f"0.0{k},0.{k},0.{k}" for k in range(20))
    path = tmp_path / "log.csv"
    path.write_text(f"t,q1,tau1\n{rows}\n" + '"\n' * 110_000)
    with pytest.raises(InputError, match=r"110000 lines of `log\.csv` are not rows"):
        read_recording(path, Columns("q{}", "tau{}", time="t"))
