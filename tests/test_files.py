"""Files are whole or not there; damaged and foreign ones are refused by name."""
import io
import pickle
import zipfile

import numpy as np
import pytest

from hind4sight_min.disk.files import load_npz, save_npz, whole_file, write_text

FORMAT = "a format 1"


@pytest.fixture
def path(tmp_path):
    """A good file with two arrays."""
    save_npz(tmp_path / "new" / "good.npz", arrays(), {"format": FORMAT, "note": [1, "two"]})
    return tmp_path / "new" / "good.npz"


def arrays():
    return {"a": np.arange(600.0).reshape(20, 30), "b": np.array([True, False])}


def assert_refused(path, *words):
    with pytest.raises(ValueError) as caught:
        load_npz(path, FORMAT)
    for word in (str(path), *words):
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_is_replaced_when_the_block_ends_well(tmp_path):
    path = tmp_path / "deep" / "er" / "figures.txt"  # the folder is made
    write_text(path, "old")
    with whole_file(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old" and temporary.suffix == ".txt" and temporary.parent == path.parent
    assert path.read_text() == "new"
    assert [each.name for each in path.parent.iterdir()] == ["figures.txt"]


@pytest.mark.parametrize("there_before", [True, False])
def test_a_file_stays_as_it_was_when_the_block_fails(tmp_path, there_before):
    path = tmp_path / "figures.txt"
    if there_before:
        write_text(path, "old")
    with pytest.raises(KeyboardInterrupt), whole_file(path) as temporary:
        temporary.write_text("half of the n")
        raise KeyboardInterrupt
    assert [each.read_text() for each in tmp_path.iterdir()] == ["old"] * there_before
    with pytest.raises(TypeError):
        save_npz(tmp_path / "no.npz", arrays(), {"format": object()})
    assert not list(tmp_path.glob("*.npz")) and not list(tmp_path.glob(".*"))


def test_arrays_and_header_come_back_as_they_were(path):
    found, meta = load_npz(str(path), FORMAT)
    assert meta == {"format": FORMAT, "note": [1, "two"]} and set(found) == set(arrays())
    for name, array in arrays().items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    assert [each.name for each in path.parent.iterdir()] == ["good.npz"]


class Trap:
    """Unpickling this would run code."""
    sprung = []

    def __reduce__(self):
        return Trap.sprung.append, (1,)


def disguise(path):
    """A trap that is as large as its header says."""
    payload, header = pickle.dumps(Trap()), io.BytesIO()
    count = -(-len(payload) // 8)
    np.lib.format.write_array_header_1_0(header, {"descr": "|O", "fortran_order": False, "shape": (count,)})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("trap.npy", header.getvalue() + payload.ljust(8 * count))


@pytest.mark.parametrize("make, words", [
    (disguise, ["damaged"]),
    (lambda path: path.unlink(), ["no such file"]),
    (lambda path: (path.unlink(), path.mkdir()), ["no such file"]),
    (lambda path: path.write_bytes(b""), ["damaged"]),
    *[(lambda path, kept=kept: path.write_bytes(path.read_bytes()[:int(kept * path.stat().st_size)]), ["damaged"])
      for kept in (0.01, 0.6, 0.99)],
    (lambda path: path.write_text("just some text\n" * 20), ["damaged"]),
    (lambda path: path.write_bytes(pickle.dumps({"a": Trap})), ["damaged"]),
    (lambda path: np.savez(path, a=np.zeros(3)), ["damaged"]),  # no header
    (lambda path: np.savez(path, meta=np.array("{}")), [f"expected format {FORMAT!r}, got None"]),
    (lambda path: np.savez(path, meta=np.array("{not json")), ["damaged"]),
    (lambda path: np.savez(path, meta=np.array('{"format": "a format 1"}'), a=np.array([Trap()], object)), ["damaged"]),
    (lambda path: np.savez(path, meta=np.array([Trap()], object)), ["damaged"]),
    (lambda path: save_npz(path, arrays(), {"format": "a format 0"}), [FORMAT, "'a format 0'"]),
    (lambda path: save_npz(path, arrays(), [1, 2]), ["damaged"])])
def test_other_files_are_refused_by_name_and_never_run(path, make, words):
    make(path)
    assert_refused(path, *words)
    assert Trap.sprung == []
