"""MATLAB files, against SciPy's writer and reader, and damaged ones."""

import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from jaxfit.errors import DatasetError
from jaxfit.labels.importers import matlab
from jaxfit.labels.importers.matlab import read_matlab

VARIABLES = {
    "doubles": np.arange(6.0).reshape(2, 3) / 7,
    "singles": np.arange(24, dtype=np.float32).reshape(2, 3, 4),
    "bytes": np.arange(3, dtype=np.uint8)[None],  # a small element
    "a_name_longer_than_eight": np.array([[-1, 2**40]]),
    "n": np.array([[-(2**15)]], np.int16),
    "empty": np.zeros((0, 2)),
}


@pytest.mark.parametrize("compressed", [True, False])
def test_arrays_are_read_as_scipy_reads_them(tmp_path, compressed):
    others = {
        "text": "seven",
        "struct": {"doubles": 3.0},
        "cell": np.array([1, "a"], object),
        "complex": np.ones(3) * 1j,
    }
    savemat(tmp_path / "x.mat", {**others, **VARIABLES}, do_compression=compressed)
    found, expected = read_matlab(tmp_path / "x.mat"), loadmat(tmp_path / "x.mat")
    assert set(found) == set(VARIABLES)
    for name, array in found.items():
        np.testing.assert_array_equal(array, expected[name], strict=True)
        np.testing.assert_array_equal(array, VARIABLES[name], strict=True)


def test_the_real_files_are_read_as_scipy_reads_them(shared_data):
    for path in sorted((shared_data / "aflw2000").glob("*.mat"))[::10]:
        found, expected = read_matlab(path), loadmat(path)
        assert set(found) == {name for name in expected if not name.startswith("__")}
        for name, array in found.items():
            np.testing.assert_array_equal(array, expected[name])


@pytest.mark.parametrize(
    "content", [b"", b"text\n" * 99, b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400)]
)
def test_files_of_another_kind(tmp_path, content):
    (tmp_path / "x.mat").write_bytes(content)
    with pytest.raises(DatasetError, match=r"x\.mat: cannot be read as a file of MATLAB 5 to 7; it does not start"):
        read_matlab(tmp_path / "x.mat")
    with pytest.raises(DatasetError, match="No such file"):
        read_matlab(tmp_path / "missing.mat")


@pytest.mark.parametrize("compressed", [True, False])
def test_every_file_that_is_cut_off_within_a_variable_is_refused(tmp_path, compressed):
    savemat(tmp_path / "x.mat", {"doubles": VARIABLES["doubles"]}, do_compression=compressed)
    data = (tmp_path / "x.mat").read_bytes()
    for size in range(129, len(data)):
        (tmp_path / "x.mat").write_bytes(data[:size])
        with pytest.raises(DatasetError, match="cannot be read"):
            read_matlab(tmp_path / "x.mat")


@pytest.mark.parametrize("compressed", [True, False])
def test_damage_is_refused_or_unseen_but_never_another_error(tmp_path, compressed):
    rng = np.random.default_rng(0)
    savemat(tmp_path / "x.mat", {"text": "seven", **VARIABLES}, do_compression=compressed)
    data = np.frombuffer((tmp_path / "x.mat").read_bytes(), np.uint8)
    refused = 0
    for _ in range(500):
        damaged = data.copy()
        damaged[rng.integers(128, len(data), 3)] = rng.integers(0, 256, 3)
        (tmp_path / "x.mat").write_bytes(damaged.tobytes())
        try:
            read_matlab(tmp_path / "x.mat")
        except DatasetError:
            refused += 1
    assert refused > 100


def test_numbers_of_unknown_types_are_refused(tmp_path):
    """SciPy's reader crashes on some of these."""
    savemat(tmp_path / "x.mat", {"doubles": VARIABLES["doubles"]})
    data = bytearray((tmp_path / "x.mat").read_bytes())
    place = data.index(VARIABLES["doubles"].tobytes("F")) - 8
    assert struct.unpack_from("<II", data, place) == (9, 48)
    for kind in (0, 8, 14, 200, 65535):
        struct.pack_into("<I", data, place, kind)
        (tmp_path / "x.mat").write_bytes(data)
        with pytest.raises(DatasetError, match=f"unknown type {kind}"):
            read_matlab(tmp_path / "x.mat")


def test_variables_that_expand_without_end_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(matlab, "_LARGEST", 1 << 20)
    packed = zlib.compress(bytes(1 << 21))
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "x.mat").write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(DatasetError, match="over 1 MiB"):
        read_matlab(tmp_path / "x.mat")


def test_small_files_do_not_become_large(tmp_path):
    """Ten variables of 60 MiB of zeros each are a file of 600 kB."""
    zeros = bytes(60 << 20)
    body = zlib.compress(struct.pack("<II", matlab._MATRIX, len(zeros)) + zeros)
    path = tmp_path / "bomb.mat"
    header = bytes(124) + b"\x00\x01IM"
    path.write_bytes(header + 10 * (struct.pack("<II", matlab._COMPRESSED, len(body)) + body))
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    with pytest.raises(DatasetError, match=r"bomb\.mat: .*"):
        read_matlab(path)
    assert tracemalloc.get_traced_memory()[1] < 300 << 20
    tracemalloc.stop()
