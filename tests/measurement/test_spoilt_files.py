"""Files that would be read as something else than they are: place and cure are named."""

import numpy as np
import polars as pl
import pytest

from jaxid.measurement.chunked_files import open_log_file
from jaxid.measurement.columns import Columns
from jaxid.measurement.recording import read_recording

COLUMNS = Columns("q{}", "tau{}", time="t")
ROWS = [f"{0.01 * k:.2f},{k},{k},1,2,moving" for k in range(60)]


def csv(folder, rows, header="t,q1,q2,tau1,tau2,note", end="\n"):
    path = folder / "log.csv"
    path.write_bytes(end.join([header, *rows, ""]).encode())
    return path


def test_quotations_do_not_swallow_rows(tmp_path):
    rows = list(ROWS)
    rows[3] = '0.03,3,3,1,2,"a ""still"" robot, held"'
    assert read_recording(csv(tmp_path, rows), COLUMNS).samples == 60
    rows[10], rows[40] = '0.10,1,1,1,2,"start', '0.40,1,1,1,2,end"'
    path = csv(tmp_path, rows)
    with pytest.raises(ValueError, match=r"line 12 of `log.csv` opens a quotation"):
        read_recording(path, COLUMNS)
    with pytest.raises(ValueError, match=r"line 12 of `log.csv` opens a quotation"):
        open_log_file(path, lambda table: tuple(table.columns))


def test_carriage_returns_alone_are_named(tmp_path):
    path = csv(tmp_path, ROWS, end="\r")
    with pytest.raises(ValueError, match=r"carriage returns alone.* save it again"):
        read_recording(path, COLUMNS)
    assert read_recording(csv(tmp_path, ROWS, end="\r\n"), COLUMNS).samples == 60


def test_one_number_in_two_columns_is_refused(tmp_path):
    path = csv(tmp_path, ROWS, header="t,q1,q2,tau1,tau2,q01")
    with pytest.raises(ValueError, match=r"`q1` and `q01`, which both are number 1 of `angles`"):
        read_recording(path, COLUMNS)
    named = Columns(("q1", "q2"), "tau{}", time="t")
    assert read_recording(path, named).samples == 60


@pytest.mark.parametrize("cell", [b"\xff", [b"1.0"], [[1.0]]])
def test_columns_of_no_numbers_are_named(tmp_path, cell):
    numbers = np.zeros(20)
    path = tmp_path / "log.parquet"
    pl.DataFrame({"t": 0.1 * np.arange(20), "q1": [cell] * 20, "tau1": numbers}).write_parquet(path)
    with pytest.raises(ValueError, match=r"`q1` of `log.parquet` holds .* and no numbers: write"):
        read_recording(path, COLUMNS)
