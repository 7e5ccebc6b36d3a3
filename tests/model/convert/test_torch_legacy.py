import hashlib
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from model.convert import torch_legacy
from model.convert.errors import ConversionError, UnsafePickleError
from model.convert.torch_legacy import read_parameters
from tests.model.convert.assembler import (
    SYSTEM,
    call,
    legacy_file,
    linear,
    mapping,
    module,
    named,
    storage,
    tensor,
    text,
)

FOUR = {"k": np.arange(4, dtype=np.float32)}


def _write(tmp_path: Path, data: bytes) -> Path:
    file = tmp_path / "weights.pt"
    file.write_bytes(data)
    return file


def _fault(tmp_path: Path, data: bytes) -> str:
    file = _write(tmp_path, data)
    with pytest.raises(ConversionError) as caught:
        read_parameters(file)
    assert str(file) in str(caught.value)
    return str(caught.value)


def test_parameters_by_name(tmp_path: Path) -> None:
    parameters = read_parameters(_write(tmp_path, legacy_file(*linear())))
    assert set(parameters) == {"NODE/part.weight", "NODE/part.bias"}
    np.testing.assert_array_equal(parameters["NODE/part.weight"], [[0, 2, 4], [1, 3, 5]])
    np.testing.assert_array_equal(parameters["NODE/part.bias"], [8, 7])
    for array in parameters.values():
        assert array.dtype == np.float32
        assert array.flags.writeable
        assert array.flags.c_contiguous


def test_every_truncation_is_noticed(tmp_path: Path) -> None:
    data = legacy_file(*linear())
    for size in range(len(data)):
        _fault(tmp_path, data[:size])
    assert "add up" in _fault(tmp_path, data + b"\0")


def test_a_name_that_is_not_allowed(tmp_path: Path) -> None:
    body = module({"weight": call(named("os", "system"), text("true"))})
    with pytest.raises(UnsafePickleError, match=r"weights\.pt: the pickle names os\.system"):
        read_parameters(_write(tmp_path, legacy_file(body)))


def test_the_other_pickles_may_name_nothing_at_all(tmp_path: Path) -> None:
    data = call(named("collections", "OrderedDict"))
    with pytest.raises(UnsafePickleError, match=r"collections\.OrderedDict"):
        read_parameters(_write(tmp_path, b"\x80\x02" + data + b"."))


def test_wrong_magic_version_and_byte_order(tmp_path: Path) -> None:
    assert "magic number" in _fault(tmp_path, legacy_file(module(), magic=3))
    assert "version 1001" in _fault(tmp_path, legacy_file(module(), version=1002))
    assert "little-endian" in _fault(
        tmp_path, legacy_file(module(), system=SYSTEM | {"little_endian": False})
    )
    assert "little-endian" in _fault(tmp_path, legacy_file(module(), system=[]))


def test_todays_zip_files_are_told_apart(tmp_path: Path) -> None:
    file = tmp_path / "new.pt"
    torch.save({"a": torch.ones(2)}, file)
    with pytest.raises(ConversionError, match="only legacy files are read"):
        read_parameters(file)


def test_a_file_that_is_not_there_or_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConversionError, match="cannot be read"):
        read_parameters(tmp_path / "nowhere.pt")
    monkeypatch.setattr(torch_legacy, "MAX_FILE_BYTES", 10)
    assert "too many" in _fault(tmp_path, legacy_file(*linear()))


@pytest.mark.parametrize(
    "parameter",
    [
        tensor(storage("k", 4), (5,), (1,)),
        tensor(storage("k", 4), (2,), (1,), offset=3),
        tensor(storage("k", 4), (2, 2), (4, 1)),
        tensor(storage("k", 4), (4,), (1,), offset=-1),
        tensor(storage("k", 4), (2,), (-1,), offset=1),
        tensor(storage("k", 4), (-2,), (1,)),
        tensor(storage("k", 4), (2,), (1, 1)),
        tensor(storage("k", 4), (2**62,), (0,)),
        tensor(storage("k", 4), (4,) * 70, (0,) * 70),
        tensor(storage("k", 4), (1,), (2**63 - 1,)),
        tensor(storage("k", 4), (2**64,), (1,)),
    ],
)
def test_tensors_out_of_bounds(tmp_path: Path, parameter: bytes) -> None:
    fault = _fault(tmp_path, legacy_file(module({"weight": parameter}), FOUR))
    assert "out of bounds" in fault or "beyond its storage" in fault


@pytest.mark.parametrize(
    ("parameter", "told"),
    [
        (tensor(storage("k", 5), (4,), (1,)), "not of 5 numbers"),
        (tensor(storage("other", 4), (4,), (1,)), "is missing"),
        (tensor(text("k"), (4,), (1,)), "not a tensor"),
        (text("weight"), "not a tensor"),
        (storage("k", 4), "not a tensor"),
        (tensor(storage("k", 4), (4, 4), (0, 1)), "overlap"),
    ],
)
def test_tensors_that_are_none(tmp_path: Path, parameter: bytes, told: str) -> None:
    assert told in _fault(tmp_path, legacy_file(module({"weight": parameter}), FOUR))


def test_tensors_that_share_a_storage_do_not_multiply_it(tmp_path: Path) -> None:
    parameter = tensor(storage("k", 4), (4,), (1,))
    assert "overlap" in _fault(tmp_path, legacy_file(module({"a": parameter, "b": parameter}), FOUR))


@pytest.mark.parametrize("count", [-1, 2**40, 2**62, 5])
def test_storages_of_absurd_size(tmp_path: Path, count: int) -> None:
    data = legacy_file(module({"weight": tensor(storage("k", 4), (4,), (1,))}), FOUR)
    data = data[:-24] + struct.pack("<q", count) + data[-16:]
    assert "file ends before" in _fault(tmp_path, data)


def test_modules_that_are_none(tmp_path: Path) -> None:
    assert "not a module" in _fault(tmp_path, legacy_file(text("a")))
    assert "child is not a module" in _fault(tmp_path, legacy_file(module(modules={"child": text("a")})))
    assert "has buffers" in _fault(tmp_path, legacy_file(module(buffers={"running_mean": text("a")})))
    linear_class = named("torch.nn.modules.linear", "Linear")
    damaged = linear_class + b")\x81" + mapping({"_parameters": text("a")}) + b"b"
    assert "damaged" in _fault(tmp_path, legacy_file(damaged))


def test_a_tree_that_is_too_deep(tmp_path: Path) -> None:
    body = module()
    for _ in range(40):
        body = module(modules={"a": body})
    assert "too large" in _fault(tmp_path, legacy_file(body))


def test_a_small_pickle_of_an_exponentially_large_tree(tmp_path: Path) -> None:
    body = module()
    for level in range(12):  # each level holds the one below it ten times over, by the memo
        fetch = b"j" + struct.pack("<I", level)
        store = b"r" + struct.pack("<I", level)
        body = module(modules={str(n): body + store if n == 0 else fetch for n in range(10)})
    assert "too large" in _fault(tmp_path, legacy_file(body))


def test_a_module_that_holds_itself(tmp_path: Path) -> None:
    head = named("torch.nn.modules.linear", "Linear") + b")\x81q\x00"
    body = head + mapping({"_modules": mapping({"self": b"h\x00"})}) + b"b"
    assert "too large" in _fault(tmp_path, legacy_file(body))


def test_a_module_that_is_there_twice(tmp_path: Path) -> None:
    body = module(modules={"a": module() + b"q\x00", "b": b"h\x00"})
    assert "a is in it twice" in _fault(tmp_path, legacy_file(body))


def test_the_number_of_modules_and_parameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_legacy, "MAX_MODULES", 4)
    monkeypatch.setattr(torch_legacy, "MAX_PARAMETERS", 2)
    one = module({"nothing": b"N"})
    assert (
        read_parameters(_write(tmp_path, legacy_file(module(modules={"a": one, "b": module(), "c": one}))))
        == {}
    )
    assert "too large: 1 _parameters in a" in _fault(
        tmp_path, legacy_file(module(modules={"a": one, "b": one, "c": one}))
    )
    assert "too large: 4 _modules in the object" in _fault(
        tmp_path, legacy_file(module(modules=dict.fromkeys("abcd", module())))
    )
    inner = module(modules=dict.fromkeys("ab", module()))
    assert "too large: 2 _modules in b" in _fault(
        tmp_path, legacy_file(module(modules={"a": inner, "b": inner}))
    )


@pytest.mark.parametrize("name", ["", "a.b"])
def test_names_that_could_be_those_of_others(tmp_path: Path, name: str) -> None:
    assert "a dot in it" in _fault(tmp_path, legacy_file(module(modules={name: module()})))
    assert "a dot in it" in _fault(tmp_path, legacy_file(module({name: b"N"})))


def test_storages_listed_twice_or_by_something_else(tmp_path: Path) -> None:
    empty = legacy_file(module())
    head = empty[: -len(pickle.dumps([], protocol=2))]
    assert "storage k is listed twice" in _fault(tmp_path, head + pickle.dumps(["k", "k"], 2) + bytes(16))
    for keys in ("k", [1], ["k" * 200], ["\x1b"]):
        assert "list of storages is damaged" in _fault(tmp_path, head + pickle.dumps(keys, 2) + bytes(16))


def test_the_published_file_bit_by_bit(shared: Path) -> None:
    parameters = read_parameters(shared / "reference/weights/trajectron_int_ee_me/model_registrar-12.pt")
    digest = hashlib.sha256()
    for name, array in parameters.items():
        digest.update(f"{name} {array.shape}".encode())
        digest.update(array.tobytes())
    assert digest.hexdigest() == "a67b67f0fe84dbd772d30dc6ad837bd2ad41ebb86cd3d7581ffc6b64f28db10b"
