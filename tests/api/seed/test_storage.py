"""Storage of shards, in a folder and in object storage: writes are atomic."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from skugga.api.seed.storage import FolderStore, ShardStore, check_writable, open_store
from skugga.terrain.errors import InputError, RenderError

BUCKET = "skugga-shards"


@pytest.fixture(scope="module")
def object_store() -> Iterator[str]:
    """Yield an address in object storage of a local server (moto)."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    keys = {
        "AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name, value in keys.items():
            patch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir(BUCKET)
        yield f"s3://{BUCKET}/run"
        s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


@pytest.fixture(params=["folder", "object store"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Address of an empty store of shards: a folder, or a prefix of an object store."""
    if request.param == "folder":
        return str(tmp_path / "shards")
    return f"{request.getfixturevalue('object_store')}/{tmp_path.name}"


def test_a_store_reads_what_it_wrote(place: str):
    store = open_store(place)
    assert store.names() == set()
    check_writable(store, place)
    store.write("ab/one.tiles", b"1" * 1000)
    store.write("cd/two.tiles", b"2")
    store.write("ab/one.tiles", b"one")
    assert store.names() == {"ab/one.tiles", "cd/two.tiles"}
    assert (store.read("ab/one.tiles"), store.read("cd/two.tiles")) == (b"one", b"2")
    with pytest.raises(FileNotFoundError):
        store.read("ab/three.tiles")
    store.delete(["ab/one.tiles", "ab/three.tiles"])
    assert open_store(place).names() == {"cd/two.tiles"}


def test_a_folder_has_no_half_written_shards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    store = FolderStore(tmp_path)
    store.write("a", b"before")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="No space left"):
        store.write("a", b"after")
    assert [path.name for path in tmp_path.iterdir()] == ["a"] and store.read("a") == b"before"
    (tmp_path / ".a.0123abcd").write_bytes(b"of a writer that died")
    assert store.names() == {"a"} and not (tmp_path / ".a.0123abcd").exists()


@pytest.mark.parametrize("address", ["nope://bucket/run", "s3:///"])
def test_unreachable_addresses_are_refused(address: str):
    with pytest.raises((InputError, RenderError), match="--shards|written"):
        check_writable(open_store(address), address)


def test_a_store_that_loses_data_is_detected(tmp_path: Path):
    class Forgetful(FolderStore):
        def read(self, name: str) -> bytes:
            return b""

    store: ShardStore = Forgetful(tmp_path)
    with pytest.raises(RenderError, match="read back differs"):
        check_writable(store, str(tmp_path))
