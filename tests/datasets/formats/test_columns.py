"""Tables, arrays and TUM files: read in pieces of any size, with the same result; memory is that of the kept rows."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fathom.datasets import DatasetError, Log, Trajectory
from fathom.datasets.described.opening import CATALOG, open_log
from fathom.datasets.formats.tables import columns as module
from fathom.datasets.formats.tables import text_table
from fathom.datasets.formats.tables.columns import read_table
from fathom.datasets.formats.tables.table import Table
from fathom.datasets.times import times_ns
from hypothesis import given
from hypothesis import strategies as st
from written import FUZZ

START = 1_700_000_000
PIECES = pytest.mark.parametrize(("rows", "size"), [(1, 1), (2, 7), (3, 100), (1000, 1 << 18)])


def pieces_of(monkeypatch: pytest.MonkeyPatch, rows: int, size: int) -> None:
    for each in (module, text_table):
        monkeypatch.setattr(each, "PIECE_ROWS", rows)
        monkeypatch.setattr(each, "PIECE_BYTES", size)


def table(folder: Path, text: str, *columns: Any, times: Any = (), **form: Any) -> dict[Any, Any]:
    encoding = form.get("encoding", "utf-8")
    (folder / "a.csv").write_bytes(text.encode(encoding))
    return read_table(folder, Table(file="a.csv", **form), columns, times)


@PIECES
def test_a_header_blanks_comments_and_a_delimiter_at_the_end_are_no_rows(tmp_path, monkeypatch, rows, size):
    pieces_of(monkeypatch, rows, size)
    lines = ["# first", "", " t ; x;y ;", "  ", *(f"{i}; {i}.5;\t{-i};" for i in range(7))]
    lines[6:6] = ["# among the rows", "", "#;;;;;"]
    for end in ("\n", "\r\n", "\r"):
        read = table(tmp_path, end.join(lines), "x", "y", times=["t"], delimiter=";", comment="#")
        assert read["x"].tolist() == [i + 0.5 for i in range(7)]
        assert read["y"].tolist() == [float(-i) for i in range(7)]
        assert read["t"].tolist() == list("0123456")


@PIECES
def test_runs_of_blanks_separate_and_columns_may_go_by_number(tmp_path, monkeypatch, rows, size):
    pieces_of(monkeypatch, rows, size)
    text = "% x\n" + "".join(f"  {i}.25\t\t {i}  1e-3 nan\n" for i in range(6))
    read = table(tmp_path, text, 1, 3, times=[0], delimiter="whitespace", comment="%", header=False)
    np.testing.assert_array_equal(read[1], np.arange(6.0))
    assert np.isnan(read[3]).all()
    assert read[0].tolist() == [f"{i}.25" for i in range(6)]


@PIECES
def test_times_in_text_keep_every_digit(tmp_path, monkeypatch, rows, size):
    pieces_of(monkeypatch, rows, size)
    stamps = [f"{START}.{i:09d}" for i in (0, 1, 999_999_999, 123_456_789)] + [f" {START + 1}", "1.7000000025E9", ""]
    read = table(tmp_path, "t,x\n" + "".join(f"{s},1\n" for s in stamps), "x", times=["t"])
    t_ns, timed = times_ns(read["t"], "s")
    expected = [int(Decimal(s or "0") * 10**9) for s in stamps]
    assert t_ns.tolist() == expected
    assert timed.tolist() == [True] * 6 + [False]


@PIECES
def test_a_word_among_numbers_is_named_with_its_row_wherever_it_is(tmp_path, monkeypatch, rows, size):
    pieces_of(monkeypatch, rows, size)
    values = [str(i) for i in range(9)]
    values[7] = "forty"
    with pytest.raises(DatasetError, match=r"a.csv: row 7: column 'x' holds 'forty', not a number"):
        table(tmp_path, "# a\nx,y\n\n" + "".join(f"{v},1\n" for v in values), "x", "y", comment="#")


@PIECES
def test_truth_values_count_as_one_and_zero_beside_numbers_too(tmp_path, monkeypatch, rows, size):
    pieces_of(monkeypatch, rows, size)
    read = table(
        tmp_path, "ok,x\n" + "".join(f"{w},1\n" for w in ("True", "true", "FALSE", "1", "0.5", "", "false")), "ok"
    )
    np.testing.assert_array_equal(read["ok"], [1, 1, 0, 1, 0.5, np.nan, 0])


@PIECES
def test_a_row_too_long_is_refused_wherever_it_is(tmp_path, monkeypatch, rows, size):
    pieces_of(monkeypatch, rows, size)
    text = "x,y\n" + "1,2\n" * 5 + "1,2,3\n" + "1,2\n" * 5
    with pytest.raises(DatasetError, match=r"a.csv: cannot be read as a table.*Expected 2 fields in line 6, saw 3"):
        table(tmp_path, text, "x")
    with pytest.raises(DatasetError, match="header names 2 columns, the rows have 3"):
        table(tmp_path, "x,y\n" + "1,2,\n" * 5 + "1,2,3\n", "x")


@PIECES
@pytest.mark.parametrize(
    ("encoding", "at", "raw", "guess"),
    [("utf-8", 9010, b"\xe9", "latin-1"), ("utf-8", 9010, b"\xc3", "latin-1"), ("ascii", 7, b"\xe9", "latin-1"),
     ("utf-8-sig", 9013, b"\xff", "latin-1"), ("utf-16", 9002, b"\x00\xdc", "utf-16")],
)  # fmt: skip
def test_the_first_byte_that_is_of_another_encoding_is_named(
    tmp_path, monkeypatch, rows, size, encoding, at, raw, guess
):
    pieces_of(monkeypatch, rows, max(size, 50))
    data = bytearray(("x,y\n" + "1234,56789\n" * 3000).encode(encoding))
    data[at : at + len(raw)] = raw
    (tmp_path / "a.csv").write_bytes(bytes(data))
    with pytest.raises(DatasetError, match=rf"a.csv: byte {at} is not {encoding}; set `encoding` \({guess}\?\)"):
        read_table(tmp_path, Table(file="a.csv", encoding=encoding), ["x"])


@pytest.mark.parametrize("text", ["", "\n\n", "# only\n# comments\n"])
def test_a_file_without_rows_is_refused_but_a_header_alone_is_a_table_of_none(tmp_path, text):
    with pytest.raises(DatasetError, match=r"a.csv: no rows"):
        table(tmp_path, text, "x", comment="#")
    read = table(tmp_path, text + "x,t\n", "x", times=["t"], comment="#")
    assert {name: len(values) for name, values in read.items()} == {"x": 0, "t": 0}


@PIECES
def test_a_parquet_file_of_many_row_groups_reads_as_one(tmp_path, monkeypatch, rows, size):
    pieces_of(monkeypatch, rows, size)
    n = 23
    when = pd.to_datetime(START * 10**9 + np.arange(n) * 10**9 + 1, unit="ns")
    frame = pd.DataFrame({"ns": np.arange(n) + START * 10**9, "when": when, "text": [f"{i}.1" for i in range(n)],
                          "x": np.arange(n) * 0.1, "ok": np.arange(n) % 2 == 0, "other": ["z"] * n})  # fmt: skip
    frame.to_parquet(tmp_path / "a.parquet", row_group_size=5, index=False)
    read = read_table(tmp_path, Table(file="a.parquet"), ["x", "ok", "text"], ["ns", "when"])
    assert read["ns"].dtype == np.int64
    np.testing.assert_array_equal(read["ns"], frame["ns"])
    np.testing.assert_array_equal(times_ns(read["when"], "s")[0], START * 10**9 + np.arange(n) * 10**9 + 1)
    np.testing.assert_array_equal(read["x"], frame["x"])
    np.testing.assert_array_equal(read["ok"], [1.0, 0.0] * 11 + [1.0])
    np.testing.assert_array_equal(read["text"], [float(f"{i}.1") for i in range(n)])
    texts = read_table(tmp_path, Table(file="a.parquet"), [], ["text"])["text"]
    assert times_ns(texts, "s")[0].tolist() == [i * 10**9 + 10**8 for i in range(n)]
    with pytest.raises(DatasetError, match=r"a.parquet: row 0: column 'other' holds 'z', not a number"):
        read_table(tmp_path, Table(file="a.parquet"), ["other"])
    with pytest.raises(DatasetError, match=r"a.parquet: no column 'txt'; did you mean 'text'\?; found ns, when, text"):
        read_table(tmp_path, Table(file="a.parquet"), ["txt"])
    with pytest.raises(DatasetError, match=r"a.parquet: no column 3; found ns"):
        read_table(tmp_path, Table(file="a.parquet"), [3])


def test_a_parquet_file_may_be_empty_or_name_a_column_twice(tmp_path):
    schema = pa.schema([("t", pa.timestamp("ns")), ("x", pa.float64())])
    pq.write_table(schema.empty_table(), tmp_path / "a.parquet")
    read = read_table(tmp_path, Table(file="a.parquet"), ["x"], ["t"])
    assert {name: len(values) for name, values in read.items()} == {"x": 0, "t": 0}
    pq.write_table(pa.Table.from_arrays([pa.array([1]), pa.array([2])], ["x", "x"]), tmp_path / "a.parquet")
    with pytest.raises(DatasetError, match="2 columns are named 'x'"):
        read_table(tmp_path, Table(file="a.parquet"), ["x"])


MEASURE = """
import resource, sys
from pathlib import Path
import numpy as np, pandas as pd
from fathom.datasets.formats.tables.columns import read_table
from fathom.datasets.formats.tables.table import Table
from fathom.datasets.times import times_ns
folder, name = Path(sys.argv[1]), sys.argv[2]
form = Table(file=name)
small = read_table(folder, Table(file="small" + Path(name).suffix), ["c1", "c2"], ["t"])  # what the libraries take
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
read = read_table(folder, form, ["c1", "c2"], ["t"])
t_ns, timed = times_ns(read["t"], "s")
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print((after - before) * (1 if sys.platform == "darwin" else 1024), len(t_ns), int(t_ns[-1]), bool(timed.all()))
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_memory_is_that_of_the_wanted_columns(tmp_path, suffix):
    """A table of 110 MB and 20 columns, of which 3 are wanted: 300,000 rows, 7 MB."""
    rng = np.random.default_rng(1)
    block = pd.DataFrame(rng.normal(size=(10_000, 19)), columns=[f"c{i}" for i in range(1, 20)]).round(16)
    block.insert(0, "t", [f"{START + i}.123456789" for i in range(10_000)])
    if suffix == ".csv":
        text = block.to_csv(index=False)
        rows = text.split("\n", 1)[1]
        with (tmp_path / "big.csv").open("w") as file:
            file.write(text)
            for _ in range(29):
                file.write(rows)
        (tmp_path / "small.csv").write_text(text)
        assert (tmp_path / "big.csv").stat().st_size > 100e6
    else:
        block.to_parquet(tmp_path / "small.parquet")
        one = pa.Table.from_pandas(block)
        with pq.ParquetWriter(tmp_path / "big.parquet", one.schema, use_dictionary=False) as writer:
            for _ in range(30):
                writer.write_table(one)
    ran = subprocess.run(
        [sys.executable, "-c", MEASURE, str(tmp_path), f"big{suffix}"], capture_output=True, text=True, check=True
    )
    grown, rows, last_ns, timed = ran.stdout.split()
    assert (int(rows), int(last_ns), timed) == (300_000, (START + 9_999) * 10**9 + 123_456_789, "True")
    assert int(grown) < 45e6  # 2.4 times what is kept, texts of times included; the whole text is 110 MB


# -- TUM


@pytest.mark.parametrize("t_ns", [[-1_500_000_000, -500_000_000, -1, 0, 1], [-800_000_000, -500_000_001]])
def test_times_before_zero_keep_their_sign_and_order_in_a_tum_file(tmp_path, t_ns):
    times = np.array(t_ns, np.int64)
    Trajectory(times, np.tile(np.eye(3), (len(times), 1, 1)), np.zeros((len(times), 3))).to_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(Trajectory.from_tum(tmp_path / "a.tum").t_ns, times)
    written = [line.split()[0] for line in (tmp_path / "a.tum").read_text().splitlines()]
    assert [Decimal(text) * 10**9 for text in written] == t_ns


@pytest.mark.parametrize("first", ["", "# pose\n"])
def test_a_byte_order_mark_before_a_tum_file_is_no_number(tmp_path, first):
    (tmp_path / "a.tum").write_text(f"{first}0.5 1 2 3 0 0 0 1\n", encoding="utf-8-sig")
    assert Trajectory.from_tum(tmp_path / "a.tum").t_ns.tolist() == [500_000_000]


def test_a_tum_file_keeps_nanoseconds_and_numbers_its_lines(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("# t x y z q\n\n1700000000.000000001, 1,2,3, 0,0,0,1\r\n1700000000.000000002 4 5 6 0 0 1 0\n")
    read = Trajectory.from_tum(path)
    assert read.t_ns.tolist() == [START * 10**9 + 1, START * 10**9 + 2]
    np.testing.assert_array_equal(read.p_WB_W, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(read.R_WB[1], np.diag([-1.0, -1, 1]), atol=1e-15)
    for line, why in {
        "3 1 2 3 0 0 0": "expected t x y z qx qy qz qw, found 7 fields",
        "3 1 2 inf 0 0 0 1": "not a finite pose with a unit quaternion (|q| = 1)",
        "3 1 2 3 0 0 0 1e200": "not a finite pose with a unit quaternion (|q| = 1e+200)",
        "3 1 2 3 0 0 0 one": "not numbers: '3 1 2 3 0 0 0 one'",
    }.items():
        path.write_text("1 1 2 3 0 0 0 1\n# a remark\n" + line + "\n")
        with pytest.raises(DatasetError) as error:
            Trajectory.from_tum(path)
        assert str(error.value) == f"{path}: line 3: {why}"


# -- arrays


@pytest.fixture
def arrays(tmp_path: Path) -> Path:
    np.save(tmp_path / "t.npy", np.arange(5) + START * 10**9)
    np.save(tmp_path / "v.npy", np.arange(15.0).reshape(5, 3))
    np.save(tmp_path / "ok.npy", np.array([True, False] * 2 + [True]))
    return tmp_path


def test_arrays_stand_side_by_side_as_columns(arrays):
    source = Table(arrays={"t": "t.npy", "v": "v.npy", "ok": "ok.npy"})
    read = read_table(arrays, source, ["v.2", "v.0", "ok"], ["t"])
    assert read["t"].dtype == np.int64
    assert read["t"].tolist() == [START * 10**9 + i for i in range(5)]
    assert read["v.2"].tolist() == [2.0, 5.0, 8.0, 11.0, 14.0]
    assert read["ok"].tolist() == [1, 0, 1, 0, 1]
    assert not any(isinstance(values, np.memmap) for values in read.values())  # the files are let go


def test_an_array_of_numbers_may_be_empty(arrays):
    np.save(arrays / "t.npy", np.zeros(0))
    assert len(read_table(arrays, Table(arrays={"t": "t.npy"}), [], ["t"])["t"]) == 0


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (np.zeros((5, 3, 2)), r"v.npy: expected numbers in rows and columns, found \(5, 3, 2\)"),
        (np.zeros(()), r"v.npy: expected numbers in rows and columns, found \(\)"),
        (np.array(["a"] * 5), r"v.npy: expected numbers in rows and columns, found"),
        (np.zeros(5, complex), r"v.npy: expected numbers in rows and columns, found"),
        (np.zeros(5, [("x", float)]), r"v.npy: expected numbers in rows and columns, found"),
        (np.array([{}] * 5, object), r"v.npy: cannot be read as an array"),
        (np.zeros((4, 3)), r"the arrays must be of equal length, found \{'t': 5, 'v': 4"),
        (np.zeros((5, 2)), r"no column 'v.2'; did you mean 'v.[01]'\?; found t, v.0, v.1"),
        (np.zeros(5), r"no column 'v.0'; found t, v$"),
        (b"not an array", r"v.npy: cannot be read as an array"),
        (b"", r"v.npy: cannot be read as an array"),
        (None, r"v.npy: no such file; did you mean '.+\.npy'"),
    ],
)
def test_what_is_no_table_of_numbers_is_refused(arrays, content, error):
    if content is None:
        (arrays / "v.npy").unlink()
    elif isinstance(content, bytes):
        (arrays / "v.npy").write_bytes(content)
    else:
        np.save(arrays / "v.npy", content, allow_pickle=True)
    with pytest.raises(DatasetError, match=error) as caught:
        read_table(arrays, Table(arrays={"t": "t.npy", "v": "v.npy"}), ["v.0", "v.2"], ["t"])
    assert str(caught.value).startswith(str(arrays))


def test_an_archive_of_arrays_is_no_array(arrays):
    np.savez(arrays / "v.npz", a=np.zeros(5))
    with pytest.raises(DatasetError, match=r"v.npz: expected numbers in rows and columns, found"):
        read_table(arrays, Table(arrays={"v": "v.npz"}), ["v"])


def test_a_pickle_is_never_opened(arrays):
    """An object array can run anything when it is loaded."""
    np.save(arrays / "v.npy", np.array([Touch(arrays / "ran")], object), allow_pickle=True)
    with pytest.raises(DatasetError, match=r"v.npy: cannot be read as an array"):
        read_table(arrays, Table(arrays={"v": "v.npy"}), ["v"])
    assert not (arrays / "ran").exists()


class Touch:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


# -- comma2k19: the checks of its README


@pytest.fixture(scope="module")
def comma(recording: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Log:
    """As catalogued, but with every speed."""
    recorded = recording("comma2k19_example1")
    described = (CATALOG / "comma2k19_example1.yaml").read_text(encoding="utf-8")
    assert "every: 8" in described
    every = tmp_path_factory.mktemp("comma") / "comma2k19_example1.yaml"
    every.write_text(described.replace("every: 8", "every: 1"), encoding="utf-8")
    return open_log(every, recorded)


def at(t_ns: Any, log_t_ns: Any, values: Any) -> Any:
    """Values of a stream at other times, linearly, column by column."""
    return np.stack([np.interp(t_ns, log_t_ns, column) for column in values.T], axis=1)


def test_comma2k19_has_the_rates_of_its_readme(comma):
    assert comma.duration_s == pytest.approx(60, abs=1)
    rates_hz = {name: 1e9 / np.diff(s.t_ns).mean() for name, s in {"imu": comma.imu, **comma.streams}.items()}
    assert rates_hz == pytest.approx({"imu": 104.3, "dvl": 82.9, "gps": 9.7}, abs=0.1)
    assert comma.truth is not None
    assert len(comma.truth) == 1200
    assert comma.truth_kind == "reference"


def test_comma2k19s_imu_is_forward_left_up_and_as_strong_as_in_its_readme(comma):
    assert np.linalg.norm(comma.imu.f_I, axis=1).mean() == pytest.approx(9.728, abs=0.001)
    assert comma.imu.f_I.mean(axis=0)[2] > 9.5
    turned = np.sum(comma.imu.w_WI_I[:, 2] * np.gradient(comma.imu.t_ns * 1e-9))
    assert np.degrees(turned) == pytest.approx(1.5, abs=0.05)  # the README's −1.5° is about the axis that points down


def test_comma2k19s_reference_lies_where_the_receiver_was(comma):
    inside = (comma.gps.t_ns > comma.truth.t_ns[0]) & (comma.gps.t_ns < comma.truth.t_ns[-1])
    off = comma.gps.z[inside] - at(comma.gps.t_ns[inside], comma.truth.t_ns, comma.truth.p_WB_W)
    horizontal = np.linalg.norm(off[:, :2], axis=1)
    assert np.sqrt(np.mean(horizontal**2)) == pytest.approx(1.47, abs=0.02)
    assert horizontal.max() == pytest.approx(2.46, abs=0.03)
    assert off[:, 2].mean() == pytest.approx(1.06, abs=0.02)


def test_comma2k19s_reference_moves_forwards_as_its_wheels_do(comma):
    speed = np.linalg.norm(comma.truth.v_WB_W[:, :2], axis=1)
    inside = (comma.truth.t_ns > comma.dvl.t_ns[0]) & (comma.truth.t_ns < comma.dvl.t_ns[-1])
    wheels = at(comma.truth.t_ns[inside], comma.dvl.t_ns, comma.dvl.z)
    off = wheels[:, 0] - speed[inside]
    assert off.mean() == pytest.approx(-0.135, abs=0.002)
    assert off.std() == pytest.approx(0.059, abs=0.002)
    np.testing.assert_array_equal(wheels[:, 1:], 0.0)
    assert np.isfinite(comma.dvl.sigma[:, 0]).all()
    assert np.isinf(comma.dvl.sigma[:, 1:]).all()
    v_B = np.einsum("nji,nj->ni", comma.truth.R_WB, comma.truth.v_WB_W).mean(axis=0)
    np.testing.assert_allclose(v_B, [16.8, -0.2, 1.1], atol=0.15)  # the README's, in forward-right-down


def test_comma2k19s_reference_is_consistent_in_its_own_frame(comma):
    """Positions differ as velocities say, and the distance and the change of course are those of the README."""
    t_s = (comma.truth.t_ns - comma.truth.t_ns[0]) * 1e-9
    v = np.gradient(comma.truth.p_WB_W, t_s, axis=0)
    assert np.abs(v - comma.truth.v_WB_W)[2:-2, :2].std() < 0.2
    steps_m = np.linalg.norm(np.diff(comma.truth.p_WB_W, axis=0), axis=1)
    assert steps_m.sum() == pytest.approx(1011, abs=3)
    course = np.unwrap(np.arctan2(comma.truth.v_WB_W[:, 1], comma.truth.v_WB_W[:, 0]))
    assert np.degrees(course[-1] - course[0]) == pytest.approx(-0.9, abs=0.05)  # the README's turns clockwise
    assert np.ptp(comma.truth.p_WB_W[:, 2]) == pytest.approx(10.7 + 8.0, abs=0.1)


# -- damage

JUNK = st.one_of(st.binary(max_size=8), st.text('0123456789,;.-e\n\r\t infa"%#', max_size=12).map(str.encode))
TEXT = b"% remark\nt ,x,y\n" + b"".join(b"%d.%03d, %d.5,-1e3,\r\n" % (START + i, i, i) for i in range(12))


def read_or_says_why(folder: Path, source: Table, columns: Any, times: Any) -> None:
    try:
        read = read_table(folder, source, columns, times)
    except DatasetError as error:
        assert str(folder) in str(error)  # noqa: PT017  (either way will do)
        return
    assert len({len(values) for values in read.values()}) == 1
    for column in times:
        t_ns, timed = times_ns(read[column], "s")
        assert len(t_ns) == len(timed) == len(read[column])


@pytest.mark.slow
@FUZZ
@given(data=st.data(), encoding=st.sampled_from(["utf-8", "latin-1", "utf-16", "utf-8-sig"]))
def test_a_damaged_text_is_read_alike_in_pieces_or_whole_or_refused(tmp_path, monkeypatch, data, encoding):
    raw = TEXT.decode().encode(encoding)
    place = data.draw(st.integers(0, len(raw)))
    (tmp_path / "a.csv").write_bytes(raw[:place] + data.draw(JUNK) + raw[place + data.draw(st.integers(0, 30)) :])
    source = Table(file="a.csv", comment="%", encoding=encoding)
    told = []
    for rows, size in ((1, 1), (5, 64), (1 << 14, 1 << 18)):
        pieces_of(monkeypatch, rows, size)
        read_or_says_why(tmp_path, source, ["x", "y"], ["t"])
        try:
            read = read_table(tmp_path, source, ["x", "y"], ["t"])
            told.append({name: [str(v) for v in values.tolist()] for name, values in read.items()})
        except DatasetError:
            told.append(None)
    assert told[0] == told[1] == told[2]


@FUZZ
@given(place=st.integers(0, 10_000), junk=st.binary(min_size=1, max_size=20), cut=st.sampled_from([0, 0, 0, 5, 500]))
def test_a_damaged_parquet_file_of_many_row_groups_is_read_or_refused(tmp_path, place, junk, cut):
    frame = pd.DataFrame({"t": [f"{START + i}.5" for i in range(20)], "x": np.arange(20) * 0.1, "y": np.arange(20)})
    frame.to_parquet(tmp_path / "a.parquet", row_group_size=6)
    raw = bytearray((tmp_path / "a.parquet").read_bytes())
    place %= len(raw)
    raw[place : place + len(junk)] = junk
    (tmp_path / "a.parquet").write_bytes(bytes(raw[: len(raw) - cut]))
    read_or_says_why(tmp_path, Table(file="a.parquet"), ["x", "y"], ["t"])


@FUZZ
@given(place=st.integers(0, 300), junk=st.binary(min_size=0, max_size=20), cut=st.sampled_from([0, 0, 1, 5, 60]))
def test_a_damaged_array_is_read_or_refused(tmp_path, place, junk, cut):
    np.save(tmp_path / "t.npy", np.arange(20.0))
    np.save(tmp_path / "v.npy", np.arange(40.0).reshape(20, 2))
    raw = (tmp_path / "v.npy").read_bytes()
    (tmp_path / "v.npy").write_bytes(raw[:place] + junk + raw[place + cut :])
    read_or_says_why(tmp_path, Table(arrays={"t": "t.npy", "v": "v.npy"}), ["v.1"], ["t"])


@FUZZ
@given(place=st.integers(0, 400), junk=JUNK, cut=st.integers(0, 30))
def test_a_damaged_tum_file_is_read_or_refused(tmp_path, place, junk, cut):
    raw = b"".join(b"%d.%09d 1.5 -2 3e0 0.6 0 0 0.8\n" % (START + i, i) for i in range(12))
    (tmp_path / "a.tum").write_bytes(raw[:place] + junk + raw[place + cut :])
    try:
        read = Trajectory.from_tum(tmp_path / "a.tum")
    except DatasetError as error:
        assert str(tmp_path / "a.tum") in str(error)  # noqa: PT017
        return
    assert isinstance(read, Trajectory)
