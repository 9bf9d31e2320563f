"""IMC logs: whole messages are kept, damaged ones skipped and counted, device clocks unwrapped."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fathom.datasets import DatasetError
from fathom.datasets.described.device_clock import onto_host, unwrap
from fathom.datasets.described.opening import open_log
from fathom.datasets.formats import imc as imc_module
from fathom.datasets.formats.imc import CRC_TABLE, Layout, built_in_layouts, parse_definitions, scan
from hypothesis import given, settings
from hypothesis import strategies as st
from written import FUZZ, log_or_error

LAYOUTS = built_in_layouts()


def crc16(data: bytes) -> int:
    """CRC-16 (IBM) bit by bit: the definition, against the module's table."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def message(name: str, timestamp: float, *values: float, src: int = 27, entity: int = 65) -> bytes:
    layout = LAYOUTS[name]
    body = np.array([values], layout.fields).tobytes()
    head = struct.pack("<HHHdHBHB", 0xFE54, layout.mgid, len(body), timestamp, src, entity, 0, 0)
    return head + body + struct.pack("<H", crc16(head + body))


def small_log(n: int = 60) -> list[bytes]:
    """IMU at 10 Hz over a wrap of a 4 s device clock, depth, and another vehicle's depth."""
    messages = []
    for i in range(n):
        host = 1000.0 + i / 10 + (0.0 if i % 5 == 0 else 0.004)
        device = (3.0 + i / 10) % 4.0
        messages.append(message("AngularVelocity", host, device, 0.1, 0.2, 0.3 + i))
        messages.append(message("Acceleration", host, device, 0.0, 0.0, -9.8))
        messages.append(message("Depth", host, 1.0 + i, entity=64))
        messages.append(message("Depth", host, 99.0, src=26, entity=64))
    return messages


DESCRIPTION: dict[str, Any] = {
    "recording": {"format": "imc", "file": "Data.lsf", "source": 27},
    "streams": {
        "imu": {
            "message": {"names": ["AngularVelocity", "Acceleration"], "entity": 65,
                        "clock": {"field": "time", "wraps_at_s": 4}},
            "time": {"column": "device"},
            "gyro": {"columns": [f"AngularVelocity.{a}" for a in "xyz"], "unit": "rad/s"},
            "accel": {"columns": [f"Acceleration.{a}" for a in "xyz"], "unit": "m/s^2"},
            "axes": "FRD",
            "noise": {"gyro_density": 1e-3, "accel_density": 1e-3, "gyro_walk": 0, "accel_walk": 0,
                      "gyro_bias_sigma": 0.1, "accel_bias_sigma": 0.1},
        },
        "depth": {"message": {"names": ["Depth"]}, "time": {"column": "timestamp"},
                  "depth": {"columns": ["value"], "unit": "m"}, "sigma_m": 0.1},
    },
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "Data.lsf").write_bytes(b"".join(small_log()))
    (tmp_path / "log.yaml").write_text(yaml.safe_dump(DESCRIPTION))
    return tmp_path


def depths(data: bytes, source: int | None = 27) -> tuple[list[float], tuple[str, ...]]:
    read = scan(io.BytesIO(data), {"Depth": LAYOUTS["Depth"]}, source, "x")
    return read.rows["Depth"]["value"].tolist(), read.notes


def test_the_crc_is_the_ibm_one():
    crc = 0
    for byte in b"123456789":
        crc = (crc >> 8) ^ int(CRC_TABLE[(crc ^ byte) & 0xFF])
    assert crc == 0xBB3D == crc16(b"123456789")


def test_streams_come_out_of_messages_in_our_frames(folder):
    log = open_log(folder)
    assert len(log.imu.t_ns) == 60
    np.testing.assert_array_equal(log.imu.w_WI_I[7], [0.1, -0.2, -7.3])
    np.testing.assert_array_equal(log.imu.f_I[7], [0.0, 0.0, 9.8])
    np.testing.assert_allclose(np.diff(log.imu.t_ns), 1e8, atol=2)  # the host's stamps jitter by 4 ms
    np.testing.assert_array_equal(log.streams["depth"].z[:, 0], -np.arange(1.0, 61.0))


@pytest.mark.parametrize("how", ["lsf", "gz", "zip", "zip-gz"])
def test_an_lsf_reads_the_same_bare_gzipped_and_out_of_an_archive(folder, how):
    data = (folder / "Data.lsf").read_bytes()
    imc: dict[str, Any] = {"format": "imc", "source": 27, "file": "Data.lsf"}
    if how == "gz":
        (folder / "Data.lsf.gz").write_bytes(gzip.compress(data))
        imc["file"] = "Data.lsf.gz"
    elif how.startswith("zip"):
        imc |= {"file": "a.zip", "member": "d/Data.lsf" + (".gz" if how == "zip-gz" else "")}
        with zipfile.ZipFile(folder / "a.zip", "w") as archive:
            archive.writestr(imc["member"], gzip.compress(data) if how == "zip-gz" else data)
    before = open_log(folder)
    (folder / "log.yaml").write_text(yaml.safe_dump({**DESCRIPTION, "recording": imc}))
    np.testing.assert_array_equal(open_log(folder).imu.t_ns, before.imu.t_ns)


@pytest.mark.parametrize("chunk_bytes", [1, 7, 64, 1000])
def test_chunks_of_any_size_give_the_same_messages(monkeypatch, chunk_bytes):
    data = bytearray(b"".join(small_log(12)))
    data[400] ^= 0xFF
    whole = depths(bytes(data))
    monkeypatch.setattr(imc_module, "CHUNK_BYTES", chunk_bytes)
    assert depths(bytes(data)) == whole


def test_a_corrupted_message_is_passed_over_and_counted():
    messages = small_log(4)
    broken = bytearray(messages[6])
    broken[21] ^= 0x10
    values, notes = depths(b"".join([*messages[:6], bytes(broken), *messages[7:]]))
    assert values == [1.0, 3.0, 4.0]
    assert notes == ("imc: 1 stretches of corrupted messages skipped", "imc: 26 bytes belong to no whole message")


def test_a_wrong_length_does_not_swallow_what_follows():
    messages = small_log(4)
    broken = bytearray(messages[6])
    broken[4:6] = b"\xff\xff"
    values, _ = depths(b"".join([*messages[:6], bytes(broken), *messages[7:]]))
    assert values == [1.0, 3.0, 4.0]


def test_a_truncated_tail_is_reported():
    data = b"".join(small_log(4))
    values, notes = depths(data[:-30])
    assert values == [1.0, 2.0, 3.0]
    assert "imc: the file ends inside a message" in notes


def test_junk_is_no_log():
    with pytest.raises(DatasetError, match="contains no whole IMC message"):
        depths(b"\x54\xfe" * 500)


@pytest.mark.parametrize(
    ("path", "value", "error"),
    [
        (("streams", "depth", "message"), {"names": ["Dept"]}, "unknown IMC message 'Dept'; did you mean 'Depth'"),
        (("streams", "depth", "message"), {"names": ["Depth"], "entity": 7}, r"no Depth from entity 7.*\[64\]"),
        (
            ("streams", "depth", "depth"),
            {"columns": ["valu"], "unit": "m"},
            "no field of Depth called 'valu'; did you mean 'value'",
        ),
        (("recording", "file"), "Dat.lsf", "no such file; did you mean 'Data.lsf'"),
        (("recording", "source"), 28, "no AngularVelocity"),
    ],
)
def test_what_is_not_in_the_log_is_named(folder, path, value, error):
    described = yaml.safe_load(yaml.safe_dump(DESCRIPTION))
    part = described
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    (folder / "log.yaml").write_text(yaml.safe_dump(described))
    with pytest.raises(DatasetError, match=error):
        open_log(folder)


def test_definitions_give_the_leading_fields_of_fixed_size():
    xml = b"""<messages><message abbrev="M" id="9"><field abbrev="a" type="uint8_t"/><field abbrev="b" type="fp32_t"/>
    <field abbrev="c" type="plaintext"/><field abbrev="d" type="fp64_t"/></message></messages>"""
    assert parse_definitions(xml, "x") == {"M": Layout(9, np.dtype([("a", "u1"), ("b", "<f4")]))}
    with pytest.raises(DatasetError, match="not a list of IMC messages"):
        parse_definitions(xml[:-4], "x")


def test_a_device_clock_that_wraps_and_drifts_returns_to_the_hosts():
    rng = np.random.default_rng(5)
    true_s = np.arange(0, 300, 0.01) + 1e9
    device = (true_s - 1e9) * (1 - 1.1e-3) + 17.0
    host = true_s + rng.exponential(0.02, len(true_s)) + rng.choice([0, 0.12], len(true_s))
    unwrapped = unwrap(host, device % 64, 64.0)
    np.testing.assert_allclose(unwrapped, device, atol=1e-9)
    np.testing.assert_allclose(onto_host(host, unwrapped), true_s, atol=5e-4)


@pytest.mark.slow
@settings(FUZZ, max_examples=80)
@given(at=st.integers(0, 15_000), junk=st.binary(max_size=60), cut=st.integers(0, 200))
def test_a_damaged_lsf_gives_a_log_or_an_error(folder, at, junk, cut):
    data = b"".join(small_log())
    (folder / "Data.lsf").write_bytes(data[: at % len(data)] + junk + data[at % len(data) + cut :])
    log_or_error(folder, repair=True)


@pytest.mark.slow
@settings(FUZZ, max_examples=40)
@given(at=st.integers(0, 10_000), junk=st.binary(min_size=1, max_size=30), kind=st.sampled_from(["zip", "gz"]))
def test_a_damaged_archive_gives_a_log_or_an_error(folder, at, junk, kind):
    data = b"".join(small_log())
    buffer = io.BytesIO()
    if kind == "zip":
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("Data.lsf", data)
    raw = bytearray(buffer.getvalue() if kind == "zip" else gzip.compress(data))
    raw[at % len(raw) : at % len(raw) + len(junk)] = junk
    (folder / f"Data.lsf.{kind}").write_bytes(bytes(raw))
    imc = {"format": "imc", "file": f"Data.lsf.{kind}", "source": 27} | (
        {"member": "Data.lsf"} if kind == "zip" else {}
    )
    (folder / "log.yaml").write_text(yaml.safe_dump({**DESCRIPTION, "recording": imc}))
    log_or_error(folder, repair=True)
