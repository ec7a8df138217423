"""Files for an import that mean harm: each is refused in one line, runs nothing and takes little memory."""

import io
import os
import pickle
import resource
import struct
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import torch
from foreign_models import SETTINGS, refused, saved, sb3_networks, write_sb3_model

from acmr.config import ConfigError
from acmr.exchange.archive import MOST_BYTES, parse_torch, read_archive, read_numbers
from acmr.exchange.sb3_reader import read_sb3

#: Kilobytes that a refusal may take beyond what was there.
LITTLE = 400_000


@pytest.fixture(autouse=True)
def _little_memory():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < LITTLE


class Harm:
    """Makes a file where it is unpickled."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


def bomb(size: int) -> bytes:
    """A zip file with one member of zeros, many times as large as itself."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file, file.open("data", "w", force_zip64=True) as member:
        for _ in range(size >> 20):
            member.write(bytes(1 << 20))
    return stream.getvalue()


def test_pickles_are_never_loaded(tmp_path, capsys):
    mark = tmp_path / "mark"
    harm = pickle.dumps(Harm(mark))
    for index, members in enumerate(
        (
            {"policy": saved({"actor": Harm(mark)})},
            {"policy": harm},
            {"variables": saved(Harm(mark))},
            {"policy": saved(sb3_networks(), _use_new_zipfile_serialization=False)},
            {"policy": saved(torch.nn.Linear(2, 2))},
        )
    ):
        path = write_sb3_model(tmp_path / f"{index}.zip", **members)
        refused(["sb3", path], ".pth: ", tmp_path, capsys)
        torch.save(Harm(mark), tmp_path / "agent.pt")
        refused(["cleanrl", tmp_path / "agent.pt"], "holds more than tensors and plain data", tmp_path, capsys)
    # The pickles that stand in data as texts are not even looked at.
    settings = {"observation_space": {":serialized:": harm.hex()}, "_last_obs": {":serialized:": "!"}}
    assert read_sb3(write_sb3_model(tmp_path / "model.zip", settings)).seed == SETTINGS["seed"]
    np.savez(tmp_path / "stats.npz", mean=np.array([Harm(mark)]), var=np.ones(1))
    with pytest.raises(ConfigError, match="mean: no vector of real numbers"):
        read_numbers(tmp_path / "stats.npz")
    assert not mark.exists()


def test_what_is_no_regular_file(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "text.zip").write_text("no zip")
    for name, says in (
        ("pipe", "no regular file"),
        (".", "no regular file"),
        ("gone", "No such"),
        ("text.zip", "no zip"),
    ):
        refused(["sb3", tmp_path / name], says, tmp_path, capsys)
        refused(["cleanrl", tmp_path / name], says, tmp_path, capsys)
    refused(["sb3", "/dev/zero"], "no regular file", tmp_path, capsys)


def test_what_would_unpack_to_too_much(tmp_path, capsys):
    (tmp_path / "bomb.zip").write_bytes(data := bomb(MOST_BYTES + (1 << 20)))
    assert len(data) < 1 << 20
    refused(["sb3", tmp_path / "bomb.zip"], "bytes when unpacked, at most", tmp_path, capsys)
    # Within another one, as the member that torch reads.
    refused(["sb3", write_sb3_model(tmp_path / "outer.zip", policy=data)], "policy.pth: 2", tmp_path, capsys)
    # One that says less than it holds is cut off at what it says.
    end = data.rfind(b"PK\x01\x02")
    lie = bytearray(data)
    struct.pack_into("<II", lie, end + 20, 100, 100)
    (tmp_path / "lie.zip").write_bytes(lie)
    with pytest.raises(ConfigError):
        read_archive(tmp_path / "lie.zip").read("data")
    with open(tmp_path / "large.zip", "wb") as file:
        file.truncate(MOST_BYTES + 1)
    refused(["sb3", tmp_path / "large.zip"], "bytes, at most", tmp_path, capsys)


def test_a_table_of_contents_without_end(tmp_path):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        for index in range(10_001):
            file.writestr(str(index), b"")
    (tmp_path / "many.zip").write_bytes(stream.getvalue())
    with pytest.raises(ConfigError, match="more than 10,000 members"):
        read_archive(tmp_path / "many.zip")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_members_of_one_name(tmp_path):
    with zipfile.ZipFile(write_sb3_model(tmp_path / "model.zip"), "a") as file:
        file.writestr("data", b"{}")
    with pytest.raises(ConfigError, match="two of its members have the same name"):
        read_sb3(tmp_path / "model.zip")


@pytest.mark.parametrize("place", range(0, 2000, 97))
def test_any_damage_is_one_line(place, tmp_path):
    data = bytearray(write_sb3_model(tmp_path / "model.zip").read_bytes())
    for flipped in (data[: place * 2], data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :]):
        (tmp_path / "damaged.zip").write_bytes(flipped)
        said, sizes = "", (8, 6)
        try:
            sizes = read_sb3(tmp_path / "damaged.zip").hidden_sizes
        except ConfigError as error:
            said = str(error)
        assert "\n" not in said
        assert sizes == (8, 6)


@pytest.mark.parametrize(
    "tensor",
    [
        torch.zeros(1).expand(10**12),
        torch.zeros(8, device="meta"),
        torch.zeros(8, dtype=torch.int64),
        torch.zeros(8, dtype=torch.complex64),
        torch.zeros(8, 8).to_sparse(),
        "text",
        None,
    ],
    ids=lambda value: str(value)[:30],
)
def test_tensors_that_are_no_numbers_in_memory(tensor, tmp_path, capsys):
    path = write_sb3_model(tmp_path / "model.zip", policy=saved(sb3_networks() | {"actor.mu.bias": tensor}))
    refused(["sb3", path], "policy.pth", tmp_path, capsys)


def test_a_storage_that_says_more_than_it_holds():
    data = saved(OrderedDict(a=torch.zeros(4)))
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        for name, content in members.items():
            more = content.replace(b"K\x04tq", b"M\x10\x27tq").replace(b"K\x04\x85", b"M\x10\x27\x85")
            assert (more != content) == name.endswith("data.pkl")
            file.writestr(name, more)
    with pytest.raises(ConfigError, match="does not match expected size"):
        parse_torch(stream.getvalue(), "it")


@pytest.mark.parametrize("shape", [(10**12,), (2,), (-1,), (3, 1)], ids=str)
def test_arrays_of_a_shape_that_is_not_theirs(shape, tmp_path):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(tmp_path / "stats.npz", "w") as file:
        file.writestr("mean.npy", stream.getvalue() + bytes(24))
    with pytest.raises(ConfigError, match="mean: "):
        read_numbers(tmp_path / "stats.npz")
