"""Files are whole or not there; damaged and foreign ones are refused by name. Our own mark the equations."""
import io
import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from hind4sight_min.disk.files import load_npz, plain, save_npz, whole_file, write_json, write_text

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


def test_json_is_sorted_and_nothing_is_written_for_no_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for nowhere in (None, ""):
        write_json(nowhere, {"b": 1})
    assert not list(tmp_path.iterdir())
    write_json("figures.json", {"b": 1, "a": [0.5]})
    text = (tmp_path / "figures.json").read_text()
    assert json.loads(text) == {"a": [0.5], "b": 1}
    assert text.index('"a"') < text.index('"b"') and text.endswith("}\n")


def test_plain_is_what_json_gives_back():
    assert plain({"sizes": (1, 2), "x": np.float32(0.5), "n": np.int64(3), "grid": np.eye(2)}) == {
        "sizes": [1, 2], "x": 0.5, "n": 3, "grid": [[1.0, 0.0], [0.0, 1.0]]}


def test_arrays_and_header_come_back_as_they_were(path):
    found, meta = load_npz(str(path), FORMAT)
    assert meta == {"format": FORMAT, "note": [1, "two"]} and set(found) == set(arrays())
    for name, array in arrays().items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    assert [each.name for each in path.parent.iterdir()] == ["good.npz"]


def test_a_damaged_header_cannot_shorten_an_array(path):
    np.savez(path, meta=np.array(json.dumps({"format": FORMAT})), **arrays())
    raw = path.read_bytes()
    assert raw.count(b"(20, 30)") == 1
    path.write_bytes(raw.replace(b"(20, 30)", b"(10, 30)"))
    assert_refused(path, "damaged")


class Trap:
    """Unpickling this would run code."""
    sprung = []

    def __reduce__(self):
        return Trap.sprung.append, (1,)


def single_array():
    np.save(buffer := io.BytesIO(), np.zeros(3))
    return buffer.getvalue()


@pytest.mark.parametrize("make, words", [
    (lambda path: path.unlink(), ["no such file"]),
    (lambda path: (path.unlink(), path.mkdir()), ["no such file"]),
    (lambda path: path.write_bytes(b""), ["damaged"]),
    *[(lambda path, kept=kept: path.write_bytes(path.read_bytes()[:int(kept * path.stat().st_size)]), ["damaged"])
      for kept in (0.01, 0.6, 0.99)],
    (lambda path: path.write_text("just some text\n" * 20), ["damaged"]),
    (lambda path: path.write_bytes(pickle.dumps({"a": Trap})), ["damaged"]),
    (lambda path: path.write_bytes(single_array()), ["damaged"]),
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


@pytest.mark.parametrize("equation", range(1, 7))
def test_every_equation_is_marked_where_it_is_computed(equation):
    package = Path(__file__).resolve().parent.parent / "hind4sight_min"
    lines = [line for path in package.rglob("*.py") for line in path.read_text().splitlines()]
    assert any(re.search(rf"\S.*# Eq\. \({equation}\)$", line) for line in lines)
