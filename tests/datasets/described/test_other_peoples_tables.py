"""Other people's tables open as they are: hemispheres, dates, words, variances, decimal commas, sentences, repeats."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from fathom.datasets import DatasetError, Log
from fathom.datasets.described.opening import open_log

START = 1_700_000_000
NS = 10**9
NOISE = dict.fromkeys(
    ("gyro_density", "accel_density", "gyro_walk", "accel_walk", "gyro_bias_sigma", "accel_bias_sigma"), 1e-3
)
IMU: dict[str, Any] = {
    "table": {"file": "imu.csv"},
    "time": {"column": "t"},
    "gyro": {"columns": ["gx", "gy", "gz"], "unit": "rad/s"},
    "accel": {"columns": ["ax", "ay", "az"], "unit": "m/s^2"},
    "noise": NOISE,
}
DVL: dict[str, Any] = {
    "table": {"file": "dvl.csv"},
    "time": {"column": "t"},
    "velocity": {"columns": ["vx", "vy", "vz"], "unit": "m/s"},
    "sigma_m_s": 0.01,
}
GPS: dict[str, Any] = {
    "table": {"file": "gps.csv"},
    "time": {"column": "t"},
    "geodetic": {"latitude": "lat", "longitude": "lon"},
    "sigma_m": 1.0,
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An IMU at rest, 10 Hz, for 10 s."""
    rows = "".join(f"{START + i // 10}.{i % 10},0,0,0,0,0,9.8\n" for i in range(101))
    (tmp_path / "imu.csv").write_text("t,gx,gy,gz,ax,ay,az\n" + rows)
    return tmp_path


def opened(folder: Path, streams: dict[str, Any], repair: bool = False, **parts: Any) -> Log:
    described = {"streams": {"imu": IMU, **copy.deepcopy(streams)}, **parts}
    (folder / "log.yaml").write_text(yaml.safe_dump(described, allow_unicode=True))
    return open_log(folder, repair=repair)


def dvl(folder: Path, text: str, repair: bool = False, **changes: Any) -> Any:
    """The DVL of a table; what is not said is that of DVL, and a None takes a key out."""
    (folder / "dvl.csv").write_text(text, encoding="utf-8")
    part = {key: value for key, value in {**DVL, **changes}.items() if value is not None}
    log = opened(folder, {"dvl": part}, repair)
    return log.dvl, log.notes


ROWS = [f"{START + 1 + i},{i / 10},0.5,-0.5" for i in range(6)]
PLAIN = "\n".join(["t,vx,vy,vz", *ROWS])


def seconds(stream: Any) -> list[float]:
    return ((stream.t_ns - START * NS) / NS).tolist()


# -- places


LAT, LON = [41.185, 41.186], [-8.706, -8.705]


@pytest.mark.parametrize(
    ("columns", "geodetic"),
    [
        ({"lat": LAT, "lon": LON}, {}),
        ({"lat": ["4111.1000", "4111.1600"], "ns": ["N", "N"], "lon": ["00842.3600", "00842.3000"], "ew": ["W", "W"]},
         {"unit": "ddmm", "north_south": "ns", "east_west": "ew"}),
        ({"lat": [411850000, 411860000], "lon": [-87060000, -87050000]}, {"unit": "degE7"}),
        ({"lat": [411850000, 411860000], "lon": [-87060000, -87050000]}, {"scale": 1e-7}),
        ({"lat": LAT, "lon": [8.706, 8.705]}, {"scale": [1, -1]}),
        ({"lat": ["41 11.1 N", "41 11.16 N"], "lon": ["8 42.36 W", "W 8 42.3"]}, {}),
        ({"lat": ["41°11'06\"N", "41°11'09.6\"N"], "lon": ["8°42'21.6\"W", "8°42'18\"W"]}, {}),
        ({"d": [41, 41], "m": [11.1, 11.16], "e": [8, 8], "f": [42, 42], "g": [21.6, 18.0], "h": ["W", "W"]},
         {"latitude": ["d", "m"], "longitude": ["e", "f", "g"], "east_west": "h"}),
        ({"lat": np.radians(LAT), "lon": np.radians(LON)}, {"unit": "rad"}),
    ],
)  # fmt: skip
@pytest.mark.parametrize("fmt", ["csv", "parquet"])
def test_a_place_is_the_same_however_it_is_written(folder, columns, geodetic, fmt):
    table = pd.DataFrame({"t": [START + 1, START + 2], **columns})
    table.to_csv(folder / "gps.csv", index=False) if fmt == "csv" else table.to_parquet(folder / "gps.parquet")
    part = {**GPS, "table": {"file": f"gps.{fmt}"}, "geodetic": {**GPS["geodetic"], **geodetic}}
    truth = {key: part[key] for key in ("table", "time", "geodetic")} | {"height_m": 0.0}
    log = opened(folder, {"gps": part}, origin={"latitude_deg": 41.185, "longitude_deg": "8°42'21.6\" W"}, truth=truth)
    assert log.gps is not None
    assert log.truth is not None
    np.testing.assert_allclose(log.gps.z[:, :2], [[0, 0], [83.898, 111.058]], atol=0.01)
    np.testing.assert_array_equal(log.truth.p_WB_W[:, :2], log.gps.z[:, :2])
    assert not [note for note in log.notes if "north and east" in note]


def test_degrees_and_minutes_without_a_sign_are_told(folder):
    (folder / "gps.csv").write_text(f"t,lat,lon\n{START + 1},4111.1,842.36\n{START + 2},4111.2,842.36\n")
    part = {**GPS, "geodetic": {**GPS["geodetic"], "unit": "ddmm"}}
    assert any("gps: all places are taken for north and east" in note for note in opened(folder, {"gps": part}).notes)
    said = {**GPS, "geodetic": {**part["geodetic"], "scale": 1}}
    assert not opened(folder, {"gps": said}).notes


@pytest.mark.parametrize(
    ("place", "why"),
    [
        ("411850000,-87060000", r"no place on earth: 411850000, -87060000 \(deg\); unit: degE7\?"),
        ("4111.1,842.36", r"no place on earth: 4111.1, 842.36 \(deg\); unit: ddmm\?"),
        ("0,0", r"no place on earth: 0, 0 \(deg\); as a receiver without a fix reports"),
        ("lat,lon", r"no place on earth: lat, lon \(deg\)"),
        ("41E,8N", r"no place on earth: 41E, 8N"),
    ],
)
def test_a_place_that_is_none_is_named_with_its_probable_unit_and_repaired_alone(folder, place, why):
    rows = "".join(f"{START + 1 + i},41.185,-8.706\n" for i in range(3))
    (folder / "gps.csv").write_text(f"t,lat,lon\n{START},{place}\n{rows}")
    with pytest.raises(DatasetError, match=r"gps: row 0 \(1 in all\): " + why + ".*--repair drops such rows"):
        opened(folder, {"gps": GPS})
    assert len(opened(folder, {"gps": GPS}, repair=True).streams["gps"]) == 3
    (folder / "gps.csv").write_text("t,lat,lon\n" + "".join(f"{START + i},{place}\n" for i in range(4)))
    if place != "0,0":  # a log may lie at 0, 0
        for repair in (False, True):
            with pytest.raises(DatasetError, match=rf"gps: 4 of 4 rows are at no place on earth, too many.*{why}"):
                opened(folder, {"gps": GPS}, repair=repair)


# -- times


@pytest.mark.parametrize("zone", ["Z", "", "+00:00"])
@pytest.mark.parametrize("blank", ["T", " "])
def test_dates_in_text_need_no_unit(folder, zone, blank):
    text = "".join(f"2023-11-14{blank}22:13:2{1 + i}.123456789{zone},1,0,0\n" for i in range(3))
    stream, _ = dvl(folder, "t,vx,vy,vz\n" + text)
    assert stream.t_ns.tolist() == [(START + 1 + i) * NS + 123456789 for i in range(3)]


def test_a_zone_is_heeded_and_a_comma_may_part_the_seconds(folder):
    stream, _ = dvl(folder, 't,vx,vy,vz\n"2023-11-15 00:13:21,5+02:00",1,0,0\n2023-11-14T17:13:22-05:00,1,0,0\n')
    assert seconds(stream) == [1.5, 2.0]


@pytest.mark.parametrize(
    "frame",
    [
        lambda t: pd.DataFrame({"t": pd.to_datetime(t, unit="ns")}),
        lambda t: pd.DataFrame({"t": pd.to_datetime(t, unit="ns").as_unit("us")}),
        lambda t: pd.DataFrame({"t": pd.to_datetime(t, unit="ns").tz_localize("UTC").tz_convert("America/New_York")}),
        lambda t: pd.DataFrame(index=pd.to_datetime(t, unit="ns").rename("t")),
        lambda t: pd.DataFrame({"t": pd.to_timedelta(t, unit="ns")}),
        lambda t: pd.DataFrame({"t": pd.Series(t).astype("Int64")}),
    ],
)
@pytest.mark.parametrize("missing", [False, True])
def test_times_as_pandas_writes_them_need_no_unit(folder, frame, missing):
    t = np.array([(START + 1 + i) * NS + 123456000 for i in range(4)])
    table = frame(t).assign(vx=1.0, vy=0.0, vz=0.0)
    if missing and "t" in table:
        table.loc[2, "t"] = None
        t = np.delete(t, 2)
    table.to_parquet(folder / "dvl.parquet")
    unit = {"unit": "ns"} if table.reset_index().t.dtype.kind == "i" else {}
    part = {**DVL, "table": {"file": "dvl.parquet"}, "time": {"column": "t", **unit}}
    assert opened(folder, {"dvl": part}, repair=missing).streams["dvl"].t_ns.tolist() == t.tolist()


def test_an_index_without_a_name_has_an_empty_name_in_csv(folder):
    index = pd.to_datetime([(START + 1 + i) * NS for i in range(3)], unit="ns")
    text = pd.DataFrame({"vx": 1.0, "vy": 0.0, "vz": 0.0}, index=index).to_csv()
    assert seconds(dvl(folder, text, time={"column": ""})[0]) == [1, 2, 3]


@pytest.mark.parametrize(
    ("stamp", "unit"),
    [(lambda i: f"{START + 1 + i},250000001", ["s", "ns"]), (lambda i: f"2023-11-14,22:13:2{1 + i}.250000001", "s")],
)
def test_two_columns_add_up_to_a_time(folder, stamp, unit):
    text = "a,b,vx,vy,vz\n" + "".join(f"{stamp(i)},1,0,0\n" for i in range(3))
    units = unit if isinstance(unit, list) else ["s", "s"]
    stream, _ = dvl(folder, text, time={"column": ["a", "b"], "unit": units, "received": ["a", "b"]})
    assert stream.t_ns.tolist() == [(START + 1 + i) * NS + 250000001 for i in range(3)]
    with pytest.raises(DatasetError, match=r"`streams.dvl.time`: unit: 2 columns need 2 units, found 1"):
        dvl(folder, text, time={"column": ["a", "b"], "unit": "s"})


def counter(text: str) -> str:
    """The stamps of a table as 32 bits of microseconds, which begin again 3 s after START."""
    head, *rows = text.splitlines()
    parts = [row.split(",", 1) for row in rows]
    stamps = [(round((float(t) - START - 3) * 1e6)) % 2**32 for t, _ in parts]
    return "\n".join([head, *(f"{stamp},{rest}" for stamp, (_, rest) in zip(stamps, parts, strict=True))])


def test_a_counter_that_wraps_is_named_and_unwrapped_if_it_is_said(folder):
    (folder / "imu.csv").write_text(counter((folder / "imu.csv").read_text()))
    text = counter("t,vx,vy,vz\n" + "".join(f"{START + 4 + i / 4},1,0,0\n" for i in range(20)))
    time = {"column": "t", "unit": "us"}
    imu = {**IMU, "time": time}
    for repair in (False, True):
        with pytest.raises(
            DatasetError, match=r"imu: 30 of 101 rows are out of order.*wraps\? `wraps_at_s: 4294.967296`"
        ):
            opened(folder, {"imu": imu}, repair)
    imu = {**IMU, "time": {**time, "wraps_at_s": 4294.967296}}
    (folder / "dvl.csv").write_text(text)
    log = opened(folder, {"imu": imu, "dvl": {**DVL, "time": imu["time"]}})
    begin = 2**32 * 1000 - 3 * NS
    np.testing.assert_array_equal(log.imu.t_ns, begin + np.arange(101) * NS // 10)
    assert log.dvl is not None
    np.testing.assert_array_equal(log.dvl.t_ns, begin + 4 * NS + np.arange(20) * NS // 4)
    assert log.notes == ("dvl: moved by 1 periods of its counter, onto the IMU's time",)


def test_a_stream_that_fits_several_periods_of_its_counter_must_say_which(folder):
    text = "t,vx,vy,vz\n" + "".join(f"{0.5 + i / 4},1,0,0\n" for i in range(4))
    (folder / "imu.csv").write_text((folder / "imu.csv").read_text().replace(str(START)[:-2], ""))
    time = {"column": "t", "wraps_at_s": 4.0}
    with pytest.raises(DatasetError, match=r"dvl: its counter begins again every 4 s.*give `clock_offset_s`"):
        dvl(folder, text, time=time)
    assert (dvl(folder, text, time={**time, "clock_offset_s": 4.0})[0].t_ns / NS).tolist() == [4.5, 4.75, 5.0, 5.25]


@pytest.mark.parametrize("far", [0, START * 2])
def test_a_stamp_of_another_year_is_refused_wherever_it_is(folder, far):
    text = PLAIN.replace(f"{START + 1}," if far == 0 else f"{START + 6},", f"{far},")
    with pytest.raises(DatasetError, match=r"dvl: row \d \(1 in all\): time \d+ ns is \d+ days from the middle"):
        dvl(folder, text)
    stream, notes = dvl(folder, text, repair=True)
    assert len(stream) == 5
    assert "dvl: 1 rows more than 400 days from the others (repair) dropped" in notes


# -- text


def test_validity_may_be_words(folder):
    text = "t,vx,vy,vz,ok\n" + "".join(f"{row},{'y' if i % 2 else 'n'}\n" for i, row in enumerate(ROWS))
    stream, notes = dvl(folder, text, valid={"column": "ok", "values": ["y"]})
    assert seconds(stream) == [2, 4, 6]
    assert "dvl: 3 rows invalid dropped" in notes
    assert seconds(dvl(folder, text.replace(",y\n", ",3.0\n"), valid={"column": "ok", "values": ["A", 3]})[0]) == [
        2,
        4,
        6,
    ]
    message = r"dvl: 6 of 6 rows are not finite.*column 'ok' holds 'n', not a number; `valid` may name text"
    with pytest.raises(DatasetError, match=message):
        dvl(folder, text, valid={"column": "ok", "values": [1]})
    stream, notes = dvl(folder, text, valid={"column": "ok", "values": ["Y"]})
    assert "dvl: no row is valid: column 'ok' holds n, y, never Y" in notes


def test_words_in_rows_that_are_invalid_do_not_matter(folder):
    text = "t,vx,vy,vz,ok\n" + "\n".join(f"{row},1" for row in ROWS) + f"\n{START + 8},---,---,---,0\n"
    assert len(dvl(folder, text, valid={"column": "ok", "values": [1]})[0]) == 6


def test_lines_of_other_kinds_are_left_out_and_counted(folder):
    lines = [line for i, row in enumerate(ROWS) for line in (f"wrz,{row},y", f"wru,0,0.070,{i}.5,-40,-95,a,b,c*9c")]
    form = {"table": {"file": "dvl.csv", "header": False, "lines": {"field": 0, "values": ["wrz"]}},
            "time": {"column": 1}, "velocity": {"columns": [2, 3, 4], "unit": "m/s"}}  # fmt: skip
    stream, notes = dvl(folder, "\n".join(lines), **form)
    assert seconds(stream) == [1, 2, 3, 4, 5, 6]
    assert "dvl: 6 lines of other kinds left out" in notes


@pytest.mark.parametrize(
    ("unit", "factor"), [("(m/s)^2", 1.0), ("m^2/s^2", 1.0), ("m²/s²", 1.0), ("(cm/s)^2", 1e-4), ("mm^2/s^2", 1e-6)]
)
def test_a_variance_is_the_square_of_a_sigma(folder, unit, factor):
    text = "t,vx,vy,vz,c\n" + "".join(f"{row},{(i + 1) ** 2}\n" for i, row in enumerate(ROWS))
    part = {"sigma_m_s": None, "variance": {"columns": ["c"], "unit": unit}}
    stream, _ = dvl(folder, text, **part)
    np.testing.assert_allclose(stream.sigma, np.sqrt(factor) * np.outer(np.arange(1, 7), np.ones(3)), rtol=1e-12)
    with pytest.raises(DatasetError, match=r"`streams.dvl.variance`: unknown unit 'm/s'"):
        dvl(folder, text, sigma_m_s=None, variance={"columns": ["c"], "unit": "m/s"})


@pytest.mark.parametrize("key", ["sigma", "variance"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "", "x"])
def test_a_spread_that_is_not_positive_is_refused_in_every_stream(folder, key, value):
    unit = {"sigma": "m/s", "variance": "(m/s)^2"}[key]
    text = "t,vx,vy,vz,c\n" + "".join(f"{row},{value if i == 2 else 1e-4}\n" for i, row in enumerate(ROWS))
    part = {"sigma_m_s": None, key: {"columns": ["c"], "unit": unit}}
    with pytest.raises(DatasetError, match=rf"dvl: row 2 \(1 in all\): {key} must be positive, found \[.*--repair"):
        dvl(folder, text, **part)
    assert len(dvl(folder, text, repair=True, **part)[0]) == 5


def test_a_decimal_comma_is_a_key_and_its_want_is_guessed(folder):
    text = PLAIN.replace(",", ";").replace(".", ",")
    text = text.replace(f"{START + 2};", f"{START + 2},250;")
    table = {"file": "dvl.csv", "delimiter": ";", "decimal": ","}
    stream, _ = dvl(folder, text, table=table)
    np.testing.assert_allclose(stream.z[:, 0], np.arange(6) / 10)
    assert seconds(stream) == [1, 2.25, 3, 4, 5, 6]
    with pytest.raises(DatasetError, match=r"time is 1700000002,250; `decimal: ','`\?"):
        dvl(folder, text, table={**table, "decimal": "."})
    with pytest.raises(DatasetError, match=r"holds '0,0', not a number; `decimal: ','`\?"):
        dvl(folder, text.replace(",250", ""), table={**table, "decimal": "."})
    with pytest.raises(DatasetError, match=r"`streams.dvl.table`: delimiter ',' cannot separate fields"):
        dvl(folder, text, table={"file": "dvl.csv", "decimal": ","})


@pytest.mark.parametrize("delimiter", ["::", "||", ".*", "[,]", "·", "(a+)+$"])
def test_a_delimiter_of_several_letters_is_taken_literally(folder, delimiter):
    stream, _ = dvl(folder, PLAIN.replace(",", delimiter), table={"file": "dvl.csv", "delimiter": delimiter})
    np.testing.assert_allclose(stream.z[:, 0], np.arange(6) / 10)


@pytest.mark.parametrize(
    ("delimiter", "meant"), [(r"\s+", "whitespace"), (r"\t", "double quotes"), ("", "cannot separate")]
)
def test_a_delimiter_that_is_meant_otherwise_is_refused(folder, delimiter, meant):
    with pytest.raises(DatasetError, match=meant):
        dvl(folder, PLAIN, table={"file": "dvl.csv", "delimiter": delimiter})


@pytest.mark.parametrize("before", ["", "# log v2\n"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "UTF8", "utf-16"])
def test_a_byte_order_mark_is_no_text(folder, before, encoding):
    dvl(folder, PLAIN)
    bom = "" if encoding == "utf-16" else "\ufeff"
    (folder / "dvl.csv").write_bytes((bom + before + PLAIN).encode("utf-16" if encoding == "utf-16" else "utf-8"))
    part = {**DVL, "table": {"file": "dvl.csv", "comment": "#", "encoding": encoding}}
    assert len(opened(folder, {"dvl": part}).streams["dvl"]) == 6


@pytest.mark.parametrize(
    "row", [f"{START + 3}.5,---,---,---", "t,vx,vy,vz", f"{START + 3}.5,,,", "restarted", f"{START + 3}.5,1_0,0,0"]
)
def test_a_row_of_text_is_dropped_by_repair_wherever_it_is(folder, row):
    lines = PLAIN.splitlines()
    text = "\n".join([*lines[:4], row, *lines[4:]])
    with pytest.raises(DatasetError, match=r"dvl: row 3 \(1 in all\): .*; --repair drops such rows"):
        dvl(folder, text)
    assert seconds(dvl(folder, text, repair=True)[0]) == [1, 2, 3, 4, 5, 6]


def test_a_line_with_too_many_fields_is_dropped_by_repair_and_counted(folder):
    lines = PLAIN.splitlines()
    text = "\n".join([*lines[:4], "restarted, for the third time, by hand, at noon, again", *lines[4:]])
    with pytest.raises(DatasetError, match=r"Expected 4 fields in line 4, saw 5"):
        dvl(folder, text)
    stream, notes = dvl(folder, text, repair=True)
    assert seconds(stream) == [1, 2, 3, 4, 5, 6]
    assert "dvl: 1 rows with too many fields (repair) dropped" in notes


def test_readings_published_again_are_dropped_if_it_is_said_and_told_if_not(folder):
    rows = [f"{START + 1 + k / 5},{k // 5},0.5,-0.5" for k in range(30)]
    text = "\n".join(["t,vx,vy,vz", *rows])
    stream, notes = dvl(folder, text, drop_repeats=True)
    assert seconds(stream) == [1, 2, 3, 4, 5, 6]
    assert "dvl: 24 rows with the values of the row before dropped" in notes
    stream, notes = dvl(folder, text)
    assert len(stream) == 30
    assert any("dvl: 80% of the rows have the values of the row before" in note for note in notes)


def test_no_message_speaks_of_numpy(folder):
    with pytest.raises(DatasetError) as error:
        dvl(folder, "\n".join(ROWS).replace("0.5", "x"), table={"file": "dvl.csv", "header": False},
            time={"column": 0}, velocity={"columns": [1, 2, 3], "unit": "m/s"})  # fmt: skip
    assert "column 2 holds 'x', not a number" in str(error.value)
    with pytest.raises(DatasetError, match=r"no column 9; found 0, 1, 2, 3"):
        dvl(folder, "\n".join(ROWS), table={"file": "dvl.csv", "header": False},
            time={"column": 0}, velocity={"columns": [1, 2, 9], "unit": "m/s"})  # fmt: skip


# -- a last line that is cut off


def cut(folder: Path, rows: list[str], last: str) -> tuple[int, list[str]]:
    stream, notes = dvl(folder, "\n".join(["t,vx,vy,vz", *rows, last]))
    return len(stream), [str(note) for note in notes if getattr(note, "kind", "") == "damage"]


FIXED = [f"{START + i // 4}.{i % 4 * 25},0.1250,0.2500,-8.7{i:03d}" for i in range(1, 13)]


@pytest.mark.parametrize("end", ["-8.", "-8", "-8.706", ""])
def test_a_last_number_that_is_cut_off_costs_its_row_and_is_told(folder: Path, end: str) -> None:
    rows, notes = cut(folder, FIXED, f"{START + 4},0.1250,0.2500,{end}")
    assert rows == 12
    assert [note[:45] for note in notes] == ["dvl: the last line is cut off, and left out; "]


def test_a_last_line_of_too_few_fields_is_cut_off_where_the_last_column_is_not_asked_for(folder: Path) -> None:
    stream, notes = dvl(folder, "\n".join(["t,vx,vy,vz,on", *(f"{row},1" for row in FIXED), f"{START + 4},1,2,-8."]))
    assert len(stream) == 12
    assert any("cut off" in note for note in notes)


@pytest.mark.parametrize(
    ("rows", "last"),
    [
        (FIXED, f"{START + 4},0.1250,0.2500,-8.7060"),
        (FIXED, f"{START + 4},0.1250,0.2500,-8.\n"),
        (FIXED[:9], f"{START + 4},0.1250,0.2500,-8."),  # too few to know
        ([f"{START + i},0,0,{1000 + i}" for i in range(12)], f"{START + 20},0,0,999"),
        ([f"{START + i},0,0,{i / 4:g}" for i in range(12)], f"{START + 20},0,0,3"),
    ],
    ids=["in full", "ended", "short table", "whole numbers", "as short as others"],
)
def test_a_last_line_without_an_end_is_kept_quietly(folder: Path, rows: list[str], last: str) -> None:
    assert cut(folder, rows, last) == (len(rows) + 1, [])


def test_a_whole_number_that_is_cut_off_is_found_by_its_length(folder: Path) -> None:
    rows = [f"{START + i},0,0,{-87060957 - i}" for i in range(12)]
    assert cut(folder, rows, f"{START + 20},0,0,-8706")[0] == 12


# -- hemispheres that are not said


@pytest.mark.parametrize("letter", ["", "nan", "NULL", "none", "E", "Nz", "-"])
def test_what_is_no_hemisphere_is_not_north(folder: Path, letter: str) -> None:
    rows = "".join(f"{START + i},41.185,{ns}\n" for i, ns in enumerate(["N", "s", " North", "south", letter, "N"]))
    (folder / "gps.csv").write_text("t,lat,ns\n" + rows)
    part = {**GPS, "geodetic": {"latitude": "lat", "longitude": "lat", "north_south": "ns"}}
    with pytest.raises(DatasetError, match=r"gps: row 4 \(1 in all\): no hemisphere: column 'ns' "):
        opened(folder, {"gps": part})
    log = opened(folder, {"gps": part}, repair=True)
    assert log.gps is not None
    assert len(log.gps) == 5


def test_a_column_of_empty_hemispheres_is_refused(folder: Path) -> None:
    (folder / "gps.csv").write_text("t,lat,ns\n" + "".join(f"{START + i},41.185,\n" for i in range(4)))
    part = {**GPS, "geodetic": {"latitude": "lat", "longitude": "lat", "north_south": "ns"}}
    with pytest.raises(DatasetError, match="4 of 4 rows are without a hemisphere"):
        opened(folder, {"gps": part})


# -- truths from files of poses, origins and units of time


@pytest.mark.parametrize(
    "key", [{"frame": "NED"}, {"height_m": 0.0}, {"every": 2}, {"drop_repeats": True}, {"time": {"column": "t"}},
            {"valid": {"column": "t", "values": [1]}}, {"position": {"columns": ["x", "y", "z"], "unit": "m"}}],
)  # fmt: skip
def test_a_key_without_effect_beside_a_file_of_poses_is_refused(folder: Path, key: dict[str, Any]) -> None:
    (folder / "truth.tum").write_text("".join(f"{START + i} 0 0 0 0 0 0 1\n" for i in range(5)))
    assert opened(folder, {}, truth={"tum": "truth.tum", "kind": "reference", "until_s": 3}).truth is not None
    with pytest.raises(DatasetError, match=f"`{next(iter(key))}`: no effect beside `tum`"):
        opened(folder, {}, truth={"tum": "truth.tum", **key})


def test_a_local_truth_beside_a_gps_on_the_globe_asks_for_the_origin(folder: Path) -> None:
    (folder / "truth.tum").write_text("".join(f"{START + i} 0 0 0 0 0 0 1\n" for i in range(5)))
    (folder / "gps.csv").write_text("t,lat,lon\n" + "".join(f"{START + i},41.185,-8.7\n" for i in range(4)))
    origin = {"latitude_deg": 41.185, "longitude_deg": -8.7}

    def checks(**parts: Any) -> list[str]:
        return [str(note) for note in opened(folder, {"gps": GPS}, **parts).notes if "state `origin`" in note]

    assert len(checks(truth={"tum": "truth.tum"})) == 1
    assert not checks()
    assert not checks(truth={"tum": "truth.tum"}, origin=origin)


@pytest.mark.parametrize(("factor", "meant"), [(10**3, "ms"), (10**6, "us"), (10**9, "ns")])
def test_times_in_a_finer_unit_than_said_are_called_so(folder: Path, factor: int, meant: str) -> None:
    rows = "\n".join(f"{(START + i) * factor},0,0,0" for i in range(5))
    with pytest.raises(DatasetError, match=rf"dvl: row 0: column 't' is {START * factor}.*seconds: `unit: {meant}`"):
        dvl(folder, f"t,vx,vy,vz\n{rows}\n")
