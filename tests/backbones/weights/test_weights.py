"""Weights: the catalogue, finding them, fetching them from a local web server, and the command line."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.reference_vectors import REFERENCE

from smust3r_colmap.backbones.weights import cache, catalogue
from smust3r_colmap.backbones.weights.cache import find_weights, named_file, part_of, weights_folder
from smust3r_colmap.backbones.weights.catalogue import CATALOGUE, LICENCE_SUMMARY, official
from smust3r_colmap.backbones.weights.checksum import verify
from smust3r_colmap.backbones.weights.download import download
from smust3r_colmap.cli import main as cli
from smust3r_colmap.cli import weights as weights_command
from smust3r_colmap.errors import CheckpointError, ConfigError, DownloadError
from smust3r_colmap.execution.progress import PlainReporter

MIB = 2**20
CONTENT = np.random.default_rng(0).bytes(5 * MIB // 2)
OTHER = np.random.default_rng(1).bytes(5 * MIB // 2)
NAME = "MUSt3R_512.pth"


def md5(content: bytes) -> str:
    return hashlib.md5(content, usedforsecurity=False).hexdigest()


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache of the test, not yet there, in an environment that says nothing else."""
    monkeypatch.setenv("SMUST3R_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("SMUST3R_WEIGHTS", raising=False)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "cache" / "weights"


# ---------------------------------------------------------------------------- a web server
class Mirror(ThreadingHTTPServer):
    """A web server with one file at every address; a test sets how well it behaves."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.content = CONTENT
        self.etag = '"one"'
        self.last_modified = ""
        self.status = 200
        self.content_type = "application/octet-stream"
        self.knows_ranges = True
        self.knows_conditions = True
        self.says_length = True
        self.shift = 0
        """Ranges begin this much too late."""
        self.cuts: list[int] = []
        """Bytes after which each of the next connections breaks."""
        self.stalls = False
        """A cut connection stays open without a sign."""
        self.released = threading.Event()
        self.requests: list[dict[str, str]] = []
        self.num_bytes_sent = 0

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class _Handler(BaseHTTPRequestHandler):
    server: Mirror

    def do_GET(self) -> None:
        mirror = self.server
        mirror.requests.append({"path": self.path, **self.headers})
        if mirror.status != 200:
            self.send_error(mirror.status)
            return
        first = self._first_byte()
        if first >= len(mirror.content):
            self.send_error(416)
            return
        self._send_headers(first)
        body = mirror.content[first:]
        if mirror.cuts:
            body = body[: mirror.cuts.pop(0)]
        mirror.num_bytes_sent += len(body)
        self.wfile.write(body)
        if mirror.stalls and first + len(body) < len(mirror.content):
            mirror.released.wait(20)

    def _first_byte(self) -> int:
        asked = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        condition = self.headers.get("If-Range")
        same = condition in (None, self.server.etag, self.server.last_modified) or not self.server.knows_conditions
        if asked is None or not self.server.knows_ranges or not same:
            return 0
        return int(asked[1]) + self.server.shift

    def _send_headers(self, first: int) -> None:
        mirror, total = self.server, len(self.server.content)
        self.send_response(206 if first else 200)
        if first:
            self.send_header("Content-Range", f"bytes {first}-{total - 1}/{total}")
        if mirror.says_length:
            self.send_header("Content-Length", str(total - first))
        self.send_header("Content-Type", mirror.content_type)
        for name, value in (("ETag", mirror.etag), ("Last-Modified", mirror.last_modified)):
            if value:
                self.send_header(name, value)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Nothing on the terminal."""


@pytest.fixture
def mirror() -> Iterator[Mirror]:
    server = Mirror()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield server
    finally:
        server.released.set()
        server.shutdown()
        thread.join()
        server.server_close()


class Fetcher:
    """``download`` of the mirror's file, with what it reported."""

    def __init__(self, mirror: Mirror, target: Path) -> None:
        self.mirror, self.target, self.said = mirror, target, io.StringIO()

    def __call__(self, content: bytes = CONTENT, *, timeout_s: float = 5.0) -> None:
        download(
            f"{self.mirror.address}/{NAME}",
            self.target,
            md5=md5(content),
            reporter=PlainReporter(self.said),
            timeout_s=timeout_s,
            pause_s=0.0,
        )

    def broken_off_at(self, num_bytes: int) -> None:
        """Leave a part of so many bytes behind."""
        self.mirror.cuts = [num_bytes, 0]
        with pytest.raises(DownloadError, match="the connection broke"):
            self()
        assert part_of(self.target).stat().st_size == num_bytes
        self.mirror.requests.clear()
        self.mirror.num_bytes_sent = 0


@pytest.fixture
def fetch(mirror: Mirror, folder: Path) -> Fetcher:
    return Fetcher(mirror, folder / NAME)


def _files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if not path.name.endswith(".lock")}


# -------------------------------------------------------------------------------- download
def test_a_file_arrives_whole_and_leaves_nothing_beside_it(fetch: Fetcher, folder: Path) -> None:
    fetch()

    assert fetch.target.read_bytes() == CONTENT
    assert _files(folder) == {NAME}
    assert ["Range" in request for request in fetch.mirror.requests] == [False]
    assert f"{NAME}, MiB: 3/3 in" in fetch.said.getvalue()


def test_a_broken_connection_is_tried_again_and_no_byte_comes_twice(fetch: Fetcher) -> None:
    fetch.mirror.cuts = [MIB, MIB // 2]
    fetch()

    assert fetch.target.read_bytes() == CONTENT
    assert fetch.mirror.num_bytes_sent == len(CONTENT)
    ranges = [(request.get("Range"), request.get("If-Range")) for request in fetch.mirror.requests]
    assert ranges == [(None, None), (f"bytes={MIB}-", '"one"'), (f"bytes={3 * MIB // 2}-", '"one"')]
    assert f"{NAME}, MiB: stopped at 1/3" in fetch.said.getvalue()
    assert fetch.said.getvalue().count("trying again") == 2


def test_what_came_before_a_lasting_break_is_kept_for_the_next_start(fetch: Fetcher, folder: Path) -> None:
    fetch.mirror.cuts = [MIB, 0]
    with pytest.raises(DownloadError, match=r"1\.0 MiB that have come are kept, the same command goes on"):
        fetch()
    assert _files(folder) == {f"{NAME}.part", f"{NAME}.part.json"}

    fetch()
    assert fetch.target.read_bytes() == CONTENT
    assert _files(folder) == {NAME}
    assert fetch.mirror.num_bytes_sent == len(CONTENT)
    assert "3/3" in fetch.said.getvalue()
    assert "1 of them already done" in fetch.said.getvalue()


@pytest.mark.parametrize("etag", ["", 'W/"weak"'])
def test_the_date_stands_in_for_a_strong_tag(fetch: Fetcher, etag: str) -> None:
    fetch.mirror.etag, fetch.mirror.last_modified = etag, "Wed, 01 Jan 2025 00:00:00 GMT"
    fetch.broken_off_at(MIB)
    fetch()

    assert fetch.mirror.requests[0]["If-Range"] == "Wed, 01 Jan 2025 00:00:00 GMT"
    assert fetch.mirror.num_bytes_sent == len(CONTENT) - MIB
    assert fetch.target.read_bytes() == CONTENT


def test_a_server_that_knows_no_ranges_sends_all_again(fetch: Fetcher) -> None:
    fetch.broken_off_at(MIB)
    fetch.mirror.knows_ranges = False
    fetch()

    assert fetch.target.read_bytes() == CONTENT
    assert fetch.mirror.num_bytes_sent == len(CONTENT)
    assert "starting over" in fetch.said.getvalue()


def test_a_server_that_cuts_and_knows_no_ranges_is_not_asked_for_ever(fetch: Fetcher) -> None:
    fetch.mirror.knows_ranges = False
    fetch.mirror.cuts = [MIB] * 10
    with pytest.raises(DownloadError, match="the connection broke"):
        fetch()

    assert len(fetch.mirror.requests) == 2


@pytest.mark.parametrize("knows_conditions", [True, False])
def test_a_file_that_changed_in_between_is_not_glued_to_the_old_part(fetch: Fetcher, knows_conditions: bool) -> None:
    fetch.broken_off_at(MIB)
    fetch.mirror.content, fetch.mirror.etag = OTHER, '"two"'
    fetch.mirror.knows_conditions = knows_conditions
    fetch(OTHER)

    assert fetch.target.read_bytes() == OTHER
    assert "starting over" in fetch.said.getvalue()


@pytest.mark.parametrize("length", [MIB // 2, 2 * MIB])
def test_a_file_that_is_shorter_now_starts_over(fetch: Fetcher, length: int) -> None:
    fetch.mirror.etag = ""
    fetch.broken_off_at(MIB)
    fetch.mirror.content = OTHER[:length]
    fetch(OTHER[:length])

    assert fetch.target.read_bytes() == OTHER[:length]
    assert ["Range" in request for request in fetch.mirror.requests] == [True, False]


def test_a_part_without_its_note_starts_over(fetch: Fetcher, folder: Path) -> None:
    fetch.broken_off_at(MIB)
    (folder / f"{NAME}.part.json").write_text("{", encoding="utf-8")
    fetch()

    assert "Range" not in fetch.mirror.requests[0]
    assert fetch.target.read_bytes() == CONTENT


def test_a_part_that_is_whole_is_not_asked_for(fetch: Fetcher, folder: Path) -> None:
    fetch.broken_off_at(MIB)
    part_of(fetch.target).write_bytes(CONTENT)
    fetch()

    assert fetch.mirror.requests == []
    assert fetch.target.read_bytes() == CONTENT


def test_a_wrong_sum_removes_what_came_and_touches_no_older_file(fetch: Fetcher, folder: Path) -> None:
    folder.mkdir(parents=True)
    fetch.target.write_bytes(b"older")
    with pytest.raises(DownloadError, match=f"has MD5 {md5(CONTENT)}, published is {md5(OTHER)}; it was removed"):
        fetch(OTHER)

    assert _files(folder) == {NAME}
    assert fetch.target.read_bytes() == b"older"


@pytest.mark.parametrize(
    ("status", "message"),
    [
        (404, "answers 404 Not Found; check --base-url"),
        (403, "answers 403 Forbidden; the server or a proxy does not let"),
        (503, "answers 503 Service Unavailable; what has come is kept, try again later"),
    ],
)
def test_a_refusal_of_the_server_is_named_and_keeps_the_part(
    fetch: Fetcher, folder: Path, status: int, message: str
) -> None:
    fetch.broken_off_at(MIB)
    fetch.mirror.status = status
    with pytest.raises(DownloadError, match=f"{fetch.mirror.address}/{NAME}: the server {message}"):
        fetch()

    assert part_of(fetch.target).stat().st_size == MIB
    assert len(fetch.mirror.requests) == 1


def test_no_network_names_the_ways_out(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        address = f"http://127.0.0.1:{closed.getsockname()[1]}/{NAME}"
    with pytest.raises(DownloadError, match=r"no connection \(.*refused\); check the network, the proxy .* --weights$"):
        download(address, folder / NAME, md5=md5(CONTENT), reporter=PlainReporter(io.StringIO()))

    assert _files(folder) == set()


def test_a_silent_server_is_left_after_the_timeout(fetch: Fetcher) -> None:
    fetch.mirror.cuts, fetch.mirror.stalls = [MIB, 0], True
    started_s = time.monotonic()
    with pytest.raises(DownloadError, match=r"the connection broke \(.*timed out\)"):
        fetch(timeout_s=0.2)

    assert 0.4 < time.monotonic() - started_s < 10.0
    assert part_of(fetch.target).stat().st_size == MIB


def test_a_full_disk_is_seen_before_anything_is_written(fetch: Fetcher, monkeypatch: pytest.MonkeyPatch) -> None:
    fetch.broken_off_at(MIB)
    missing = len(CONTENT) - MIB
    usage = SimpleNamespace(free=missing - 1)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    with pytest.raises(DownloadError, match=r"1\.5 MiB are missing and the disk has 1\.5 MiB free; make room.*CACHE"):
        fetch()
    assert part_of(fetch.target).stat().st_size == MIB

    usage.free = missing
    fetch()
    assert fetch.target.read_bytes() == CONTENT


class _FullDisk(io.FileIO):
    """A file on a disk with room for 1 MiB and a bit."""

    def write(self, data: Any) -> int:
        room = MIB + 100 - self.tell()
        if len(data) <= room:
            return super().write(data)
        super().write(data[:room])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_disk_that_fills_up_on_the_way_keeps_the_part(fetch: Fetcher, monkeypatch: pytest.MonkeyPatch) -> None:
    really_open = Path.open

    def opened(path: Path, mode: str = "r", *args: Any, **options: Any) -> Any:
        return _FullDisk(path, mode) if mode == "ab" else really_open(path, mode, *args, **options)

    with monkeypatch.context() as full:
        full.setattr(Path, "open", opened)
        with pytest.raises(DownloadError, match=rf"{NAME}.part: No space left on device; what has come is kept; make"):
            fetch()
    assert part_of(fetch.target).stat().st_size == MIB + 100

    fetch()
    assert fetch.target.read_bytes() == CONTENT
    assert fetch.mirror.requests[-1]["Range"] == f"bytes={MIB + 100}-"


def test_a_log_in_page_does_not_cost_the_part(fetch: Fetcher) -> None:
    fetch.broken_off_at(MIB)
    fetch.mirror.content, fetch.mirror.etag, fetch.mirror.content_type = b"<html>", "", "text/html; charset=utf-8"
    fetch.mirror.knows_ranges = False
    with pytest.raises(DownloadError, match=r"what comes is a web page \(a log-in"):
        fetch()

    assert part_of(fetch.target).stat().st_size == MIB


def test_a_file_of_unknown_length_is_refused(fetch: Fetcher) -> None:
    fetch.mirror.says_length = False
    with pytest.raises(DownloadError, match="does not say how long the file is"):
        fetch()


def test_bytes_that_nobody_asked_for_are_refused(fetch: Fetcher) -> None:
    fetch.broken_off_at(MIB)
    fetch.mirror.shift = 7
    with pytest.raises(DownloadError, match=f"bytes from {MIB} on, the server sends those from {MIB + 7} on"):
        fetch()

    assert part_of(fetch.target).stat().st_size == MIB


def test_a_cache_that_cannot_be_written_is_named(fetch: Fetcher, folder: Path) -> None:
    folder.parent.mkdir()
    folder.write_bytes(b"")
    with pytest.raises(DownloadError, match=r"weights/MUSt3R_512.pth: .*exists.*SMUST3R_CACHE"):
        fetch()


def test_the_proxy_of_the_environment_is_used(fetch: Fetcher, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", fetch.mirror.address)
    monkeypatch.setenv("no_proxy", "")
    address = f"http://nowhere.invalid/{NAME}"
    download(address, fetch.target, md5=md5(CONTENT), reporter=PlainReporter(fetch.said))

    assert [request["path"] for request in fetch.mirror.requests] == [address]
    assert fetch.target.read_bytes() == CONTENT


# -------------------------------------------------------------------------- more processes
_CHILD = """
import signal
import sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs are born deaf to Ctrl-C
from dataclasses import replace
from smust3r_colmap.backbones.weights import catalogue
catalogue.CATALOGUE = [replace(catalogue.CATALOGUE[0], md5=sys.argv[1])]
from smust3r_colmap.cli.main import main
sys.exit(main(["weights", "fetch", "--accept-licence", "--base-url", sys.argv[2]]))
"""


@contextmanager
def _child_in_the_middle(fetch: Fetcher) -> Iterator[subprocess.Popen[str]]:
    """A process that has fetched 1 MiB and waits for the server."""
    fetch.mirror.cuts, fetch.mirror.stalls = [MIB], True
    part = part_of(fetch.target)
    program = [sys.executable, "-c", _CHILD, md5(CONTENT), fetch.mirror.address]
    with subprocess.Popen(program, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        give_up_s = time.monotonic() + 30
        while child.poll() is None and time.monotonic() < give_up_s:
            if part.exists() and part.stat().st_size > MIB // 2:
                break
            time.sleep(0.01)
        try:
            yield child
        finally:
            child.kill()


def test_two_processes_do_not_fetch_the_same_file(fetch: Fetcher) -> None:
    with _child_in_the_middle(fetch), pytest.raises(DownloadError, match="another process is fetching it; wait"):
        fetch()

    fetch()  # a killed process holds no lock
    assert fetch.target.read_bytes() == CONTENT


def test_an_interrupted_fetch_exits_130_and_is_taken_up(fetch: Fetcher) -> None:
    with _child_in_the_middle(fetch) as child:
        child.send_signal(signal.SIGINT)
        err = child.communicate(timeout=60)[1]
    assert child.returncode == 130
    assert "the same command goes on" in err
    had = part_of(fetch.target).stat().st_size
    assert MIB // 2 < had <= MIB

    fetch()
    assert fetch.mirror.requests[-1]["Range"] == f"bytes={had}-"
    assert fetch.target.read_bytes() == CONTENT


# ----------------------------------------------------------------------------- the catalogue
def test_the_catalogue_is_that_of_the_network_specification() -> None:
    specification = REFERENCE / "must3r" / "SPEC.md"
    if not specification.is_file():
        pytest.skip(f"no network specification at {specification}")
    rows = re.findall(r"^\| `([\w.]+)` \| ([0-9a-f]{32}) \|", specification.read_text(encoding="utf-8"), re.MULTILINE)

    assert len(rows) == 7
    assert [(file.name, file.md5) for file in CATALOGUE] == rows
    assert f"`{catalogue.BASE_ADDRESS}/<file>`" in specification.read_text(encoding="utf-8")


def test_every_official_file_says_its_size_and_kind() -> None:
    for file in CATALOGUE:
        assert f"_{file.image_size}" in file.name
        assert ("retrieval" in file.name) == (file.kind != "network")
        assert file.name.endswith(".pkl") == (file.kind == "codebook")


def test_the_licence_says_what_binds_and_where_to_read_it() -> None:
    text = " ".join(LICENCE_SUMMARY.split())
    for part in ("non-commercial purposes only", "NAVER", "https://github.com/naver/must3r", "ScanNet++", "Map-free"):
        assert part in text
    assert max(map(len, LICENCE_SUMMARY.splitlines())) <= 100


def test_a_misspelt_name_is_told_the_right_one() -> None:
    with pytest.raises(ConfigError, match=r"MUSt3R_521.pth: no official file of MUSt3R; did you mean MUSt3R_512.pth"):
        official("MUSt3R_521.pth")


# -------------------------------------------------------------------------------- the cache
def test_the_cache_lies_where_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.setenv("XDG_CACHE_HOME", "/caches")
    monkeypatch.setenv("SMUST3R_CACHE", "~/mine")
    assert weights_folder() == Path("/home/me/mine/weights")
    monkeypatch.delenv("SMUST3R_CACHE")
    assert weights_folder() == Path("/caches/smust3r-colmap/weights")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert weights_folder() == Path("/home/me/.cache/smust3r-colmap/weights")


def _put(path: Path, content: bytes = b"weights") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("cached", "network_size", "taken"),
    [
        (["MUSt3R_512.pth"], 512, "MUSt3R_512.pth"),
        (["MUSt3R_512.pth", "MUSt3R_512.safetensors"], 512, "MUSt3R_512.safetensors"),
        (["MUSt3R_512.pth", "MUSt3R_512_cvpr.safetensors"], 512, "MUSt3R_512.pth"),
        (["MUSt3R_512_cvpr.pth"], 768, "MUSt3R_512_cvpr.pth"),
        (["MUSt3R_224_cvpr.pth", "MUSt3R_512.pth"], 240, "MUSt3R_512.pth"),
        (["MUSt3R_224_cvpr.pth", "MUSt3R_512.pth"], 224, "MUSt3R_224_cvpr.pth"),
    ],
)
def test_the_cache_gives_the_network_for_the_size(
    folder: Path, cached: list[str], network_size: int, taken: str
) -> None:
    for name in cached:
        _put(folder / name)

    assert find_weights(None, network_size) == folder / taken


def test_the_flag_comes_before_the_variable_and_the_variable_before_the_cache(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _put(folder / "MUSt3R_512.pth")
    flag, variable = _put(tmp_path / "flag.pth"), _put(tmp_path / "variable.pth")
    monkeypatch.setenv("SMUST3R_WEIGHTS", str(variable))

    assert find_weights(str(flag), 512) == flag
    assert find_weights(None, 512) == variable
    monkeypatch.setenv("SMUST3R_WEIGHTS", "")
    assert find_weights(None, 512) == folder / "MUSt3R_512.pth"


def test_an_official_name_is_looked_up_in_the_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _put(folder / "MUSt3R_224_cvpr.safetensors")
    monkeypatch.setenv("SMUST3R_WEIGHTS", "MUSt3R_224_cvpr.pth")

    assert find_weights("MUSt3R_224_cvpr.pth", 512) == folder / "MUSt3R_224_cvpr.safetensors"
    assert find_weights(None, 512) == folder / "MUSt3R_224_cvpr.safetensors"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("nowhere/x.pth", "--weights nowhere/x.pth: no such file; name a checkpoint"),
        ("nowhere/MUSt3R_512.pth", "--weights nowhere/MUSt3R_512.pth: no such file"),
        (".", r"--weights \.: is a folder"),
        ("MUSt3R_512.pth", "is not in the cache .*; fetch it with `smust3r-colmap weights fetch MUSt3R_512.pth`"),
        ("MUSt3R_224_retrieval_codebook.pkl", "is a codebook, needed is a network such as MUSt3R_512.pth"),
    ],
)
def test_weights_that_are_not_there_are_refused(given: str, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        find_weights(given, 512)


def test_a_variable_that_names_nothing_is_refused_under_its_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _put(folder / "MUSt3R_512.pth")
    monkeypatch.setenv("SMUST3R_WEIGHTS", "nowhere.pth")
    with pytest.raises(CheckpointError, match=r"^SMUST3R_WEIGHTS nowhere.pth: no such file"):
        find_weights(None, 512)


@pytest.mark.parametrize(("network_size", "name"), [(512, "MUSt3R_512.pth"), (224, "MUSt3R_224_cvpr.pth")])
def test_without_weights_every_way_to_them_is_said(network_size: int, name: str) -> None:
    with pytest.raises(CheckpointError) as refusal:
        find_weights(None, network_size)
    for part in (f"weights fetch {name}`", "--weights FILE", "SMUST3R_WEIGHTS", "--backbone classical needs none"):
        assert part in str(refusal.value)
    assert "which is there" not in str(refusal.value)


def test_a_network_of_the_other_size_is_offered_not_taken(folder: Path) -> None:
    _put(folder / "MUSt3R_224_cvpr.pth")
    with pytest.raises(CheckpointError, match=r"`--weights MUSt3R_224_cvpr.pth`, which is there"):
        find_weights(None, 512)


def test_a_retrieval_head_is_found_as_such(folder: Path) -> None:
    name = "MUSt3R_512_retrieval_trainingfree.pth"
    _put(folder / name)

    assert named_file(name, said_by="--retrieval-weights", kind="retrieval head") == folder / name
    with pytest.raises(CheckpointError, match="is a network, needed is a retrieval head such as"):
        named_file("MUSt3R_512.pth", said_by="--retrieval-weights", kind="retrieval head")


# --------------------------------------------------------------------------------- checksums
@pytest.fixture
def known_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the published sum of NAME be that of CONTENT."""
    changed = [replace(file, md5=md5(CONTENT)) if file.name == NAME else file for file in CATALOGUE]
    for module in (catalogue, cache, weights_command):
        monkeypatch.setattr(module, "CATALOGUE", changed)


@pytest.mark.usefixtures("known_sum")
@pytest.mark.parametrize(
    ("name", "content", "sound", "text"),
    [
        (NAME, CONTENT, True, "is MUSt3R_512.pth as published"),
        ("copy.pth", CONTENT, True, "is MUSt3R_512.pth as published"),
        (NAME, CONTENT[:-1], False, f"published is {md5(CONTENT)}: damaged or changed"),
        ("MUSt3R_512_cvpr.pth", CONTENT, False, "published is 43808705f381a8724aafcd27c88ece35"),
        ("copy.pth", OTHER, False, "none of the published sums"),
    ],
)
def test_a_file_is_sound_only_as_published(tmp_path: Path, name: str, content: bytes, sound: bool, text: str) -> None:
    decision = verify(_put(tmp_path / name, content))

    assert decision.sound == sound
    assert text in decision.text
    assert str(tmp_path / name) in decision.text


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="cannot be read"):
        verify(tmp_path)


# -------------------------------------------------------------------------- the command line
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """``run("list")`` gives exit code, standard output and standard error of ``weights list``."""

    def run_command(*arguments: str) -> tuple[int, str, str]:
        capsys.readouterr()
        exit_code = cli.main(["weights", *arguments])
        return exit_code, *capsys.readouterr()

    return run_command


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.usefixtures("known_sum")
def test_fetch_asks_for_consent_and_prints_the_path(run: Run, fetch: Fetcher, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", _Terminal("yes\n"))
    exit_code, out, err = run("fetch", NAME, "--base-url", f"{fetch.mirror.address}/must3r/")

    assert (exit_code, out) == (0, f"{fetch.target}\n")
    assert LICENCE_SUMMARY in err
    assert f"fetch {NAME}? Type yes or no: " in err
    assert fetch.mirror.requests[0]["path"] == f"/must3r/{NAME}"
    assert fetch.target.read_bytes() == CONTENT


@pytest.mark.usefixtures("known_sum")
@pytest.mark.parametrize("answer", ["no\n", "y\n", "\n", ""])
def test_fetch_without_a_whole_yes_fetches_nothing(
    run: Run, fetch: Fetcher, monkeypatch: pytest.MonkeyPatch, answer: str
) -> None:
    monkeypatch.setattr("sys.stdin", _Terminal(answer))
    exit_code, out, err = run("fetch", NAME, "--base-url", fetch.mirror.address)

    assert (exit_code, out) == (1, "")
    assert "not accepted; nothing was fetched" in err
    assert fetch.mirror.requests == []


@pytest.mark.usefixtures("known_sum")
def test_fetch_without_a_terminal_names_the_flag(run: Run, fetch: Fetcher, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("yes\n"))
    exit_code, out, err = run("fetch", NAME, "--base-url", fetch.mirror.address)

    assert (exit_code, out) == (2, "")
    assert "no terminal to ask for consent; read the licence and give --accept-licence" in err
    assert fetch.mirror.requests == []


@pytest.mark.usefixtures("known_sum")
def test_fetch_with_the_flag_asks_nobody_but_shows_the_licence(run: Run, fetch: Fetcher) -> None:
    exit_code, out, err = run("fetch", "--accept-licence", "--base-url", fetch.mirror.address)

    assert (exit_code, out) == (0, f"{fetch.target}\n")
    assert LICENCE_SUMMARY in err
    assert "Type yes" not in err


@pytest.mark.usefixtures("known_sum")
def test_a_sound_file_is_not_fetched_again_and_a_damaged_one_is(run: Run, fetch: Fetcher) -> None:
    _put(fetch.target, CONTENT[:-1])
    command = ("fetch", "--accept-licence", "--base-url", fetch.mirror.address)
    exit_code, _, err = run(*command)
    assert exit_code == 0
    assert "damaged or changed" in err
    assert len(fetch.mirror.requests) == 1

    exit_code, out, err = run(*command)
    assert (exit_code, out) == (0, f"{fetch.target}\n")
    assert "as published" in err
    assert len(fetch.mirror.requests) == 1


def test_fetch_exits_1_when_the_server_refuses_and_2_on_a_name_or_address_it_cannot_use(
    run: Run, mirror: Mirror
) -> None:
    mirror.status = 404
    exit_code, out, err = run("fetch", NAME, "--accept-licence", "--quiet", "--base-url", mirror.address)
    assert (exit_code, out) == (1, "")
    assert f"smust3r-colmap: {mirror.address}/{NAME}: the server answers 404" in err

    assert run("fetch", "MUSt3R.pth", "--accept-licence")[0] == 2
    exit_code, _, err = run("fetch", NAME, "--accept-licence", "--base-url", "file:///tmp")
    assert exit_code == 2
    assert "must begin with http" in err


def test_list_has_every_file_with_its_sum_and_what_is_in_the_cache(run: Run, folder: Path) -> None:
    _put(folder / "MUSt3R_512.pth", bytes(2 * MIB))
    _put(folder / "MUSt3R_512.safetensors", bytes(MIB))
    _put(folder / "MUSt3R_512_cvpr.pth.part", bytes(MIB))
    exit_code, out, _ = run("list")
    lines = {line.split()[0]: line for line in out.splitlines()[1:8]}

    assert exit_code == 0
    assert list(lines) == [file.name for file in CATALOGUE]
    for file in CATALOGUE:
        assert f" {file.image_size} px  {file.md5} " in lines[file.name]
    assert lines["MUSt3R_512.pth"].endswith("  2.0 MiB, converted 1.0 MiB")
    assert lines["MUSt3R_512_cvpr.pth"].endswith("  broken off at 1.0 MiB")
    assert lines["MUSt3R_224_cvpr.pth"].endswith("  no, about 1615.3 MiB")
    assert lines["MUSt3R_224_retrieval_codebook.pkl"].endswith("  no")
    assert f"The cache is {folder}." in out
    assert "SMUST3R_WEIGHTS is not set" in out


def test_path_prints_what_a_reconstruction_would_take(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exit_code, out, err = run("path")
    assert (exit_code, out) == (1, "")
    assert "weights fetch MUSt3R_512.pth" in err

    large, small = _put(folder / "MUSt3R_512.pth"), _put(folder / "MUSt3R_224_cvpr.pth")
    assert run("path") == (0, f"{large}\n", "")
    assert run("path", "--network-size", "224") == (0, f"{small}\n", "")
    assert run("path", "MUSt3R_224_cvpr.pth") == (0, f"{small}\n", "")
    monkeypatch.setenv("SMUST3R_WEIGHTS", str(_put(tmp_path / "mine.pth")))
    assert run("path") == (0, f"{tmp_path / 'mine.pth'}\n", "")

    exit_code, out, err = run("path", "MUSt3R_512_cvpr.pth")
    assert (exit_code, out) == (1, "")
    assert "MUSt3R_512_cvpr.pth: is not in the cache" in err
    assert run("path", "MUSt3R.pth")[0] == 2


@pytest.mark.usefixtures("known_sum")
def test_verify_without_a_name_takes_all_official_files_of_the_cache(run: Run, folder: Path) -> None:
    exit_code, out, err = run("verify")
    assert (exit_code, out) == (1, "")
    assert "has no official file; fetch it with" in err

    _put(folder / NAME, CONTENT)
    _put(folder / "other.pth", OTHER)
    exit_code, out, _ = run("verify")
    assert (exit_code, len(out.splitlines())) == (0, 1)

    _put(folder / "MUSt3R_224_cvpr.pth", OTHER)
    exit_code, out, _ = run("verify")
    assert (exit_code, len(out.splitlines())) == (1, 2)
    assert f"{folder / NAME}: is {NAME} as published" in out
    assert f"{folder / 'MUSt3R_224_cvpr.pth'}: has MD5 {md5(OTHER)}" in out


@pytest.mark.usefixtures("known_sum")
def test_verify_takes_a_file_or_a_name(run: Run, folder: Path, tmp_path: Path) -> None:
    _put(folder / NAME, CONTENT)
    assert run("verify", NAME)[0] == 0
    assert run("verify", str(_put(tmp_path / "copy.pth", CONTENT)))[0] == 0
    assert run("verify", str(_put(tmp_path / "odd.pth", OTHER)))[0] == 1
    exit_code, _, err = run("verify", "MUSt3R_224_cvpr.pth")
    assert exit_code == 1
    assert "is not there; fetch it with" in err
    assert run("verify", str(tmp_path / "missing.pth"))[0] == 2


@pytest.fixture
def converter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets ``convert_checkpoint`` copy the file."""

    def convert_checkpoint(source: Path, target: Path) -> None:
        target.write_bytes(b"converted " + source.read_bytes())

    package, module = ModuleType("must3r"), ModuleType("checkpoint")
    module.convert_checkpoint = convert_checkpoint  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "smust3r_colmap.backbones.must3r", package)
    monkeypatch.setitem(sys.modules, "smust3r_colmap.backbones.must3r.checkpoint", module)


@pytest.mark.usefixtures("converter")
def test_convert_writes_beside_the_source_or_where_told(run: Run, folder: Path, tmp_path: Path) -> None:
    _put(folder / NAME)
    exit_code, out, _ = run("convert", NAME)
    assert (exit_code, out) == (0, f"{folder / 'MUSt3R_512.safetensors'}\n")
    assert (folder / "MUSt3R_512.safetensors").read_bytes() == b"converted weights"
    assert run("path")[1] == f"{folder / 'MUSt3R_512.safetensors'}\n"

    target = tmp_path / "other.safetensors"
    assert run("convert", str(folder / NAME), str(target))[:2] == (0, f"{target}\n")
    assert target.read_bytes() == b"converted weights"


@pytest.mark.usefixtures("converter")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.pth"], "nowhere.pth: no such file; name a checkpoint or an official file"),
        ([NAME], "cache/weights/MUSt3R_512.pth: no such file"),
        (["here.pth", "there.pth"], "there.pth: the name of the target must end with .safetensors"),
        (["here.pth"], "here.safetensors: is there already; delete it or name another target"),
    ],
)
def test_convert_refuses_what_it_cannot_read_or_would_overwrite(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    _put(Path("here.pth"))
    _put(Path("here.safetensors"))
    exit_code, out, err = run("convert", *arguments)

    assert (exit_code, out) == (2, "")
    assert message in err
    assert Path("here.safetensors").read_bytes() == b"weights"


@pytest.mark.parametrize(
    ("command", "usage", "closing"),
    [
        ("fetch", "[NAME]", f"(default: {NAME})"),
        ("verify", "[FILE|NAME]", "(optional)"),
        ("convert", "SOURCE [TARGET.safetensors]", "(optional)"),
        ("path", "[NAME]", "(optional)"),
    ],
)
def test_help_tells_what_may_be_left_out(
    command: str, usage: str, closing: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        cli.main(["weights", command, "--help"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"weights {command} [-h] {usage} [--quiet]" in said
    assert closing in said
    assert "(default: '')" not in said
    assert "(default: None)" not in said


def test_help_of_weights_needs_no_network_code() -> None:
    program = """
import contextlib, sys
from smust3r_colmap.cli.main import main
with contextlib.suppress(SystemExit):
    main(["weights", "fetch", "--help"])
print("LOADED", sorted({"torch", "numpy", "requests", "filelock"} & set(sys.modules)))
"""
    child = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert "--accept-licence" in child.stdout
    assert child.stdout.splitlines()[-1] == "LOADED []"
