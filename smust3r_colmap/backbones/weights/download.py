"""Downloading one large file with resume: after a break only the missing bytes are requested.

The bytes go to ``NAME.part``. Beside it ``NAME.part.json`` has the length of the whole file and what the server calls
this version of it (an ETag or a date), so that the rest is asked for with Range and If-Range (RFC 9110, sections
13.1.5 and 14.2): a server whose file has changed sends the new one whole, and so does one that cannot send a part.
``NAME`` appears when all bytes are there and their sum is right.

``requests`` does the transfer and takes proxies from the environment. pooch would do the rest but for resuming: it
begins a file anew after each break, which for 1.6 GiB is the point of this module.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from http import HTTPStatus
from pathlib import Path

import requests
from filelock import FileLock, Timeout

from smust3r_colmap import __version__
from smust3r_colmap.backbones.weights.cache import CACHE_VARIABLE, part_of
from smust3r_colmap.backbones.weights.checksum import md5_of
from smust3r_colmap.errors import DownloadError
from smust3r_colmap.execution.progress import Reporter

_MIB = 2**20
_BLOCK_BYTES = 2**16
"""Read at once; of a block that breaks off nothing is kept."""

# Ways out, for messages.
_OTHER_DISK = f"make room, or name a folder on another disk in the environment variable {CACHE_VARIABLE}"
_BY_HAND = "get the file by other means, say a browser, and name it with --weights"


def download(
    address: str, target: Path, *, md5: str, reporter: Reporter, timeout_s: float = 30.0, pause_s: float = 2.0
) -> None:
    """Fetch ``address`` into ``target``, resuming an earlier call that was interrupted.

    Args:
        address: http or https.
        target: replaced if it exists; its folder is made.
        md5: sum that the whole file must have.
        reporter: gets progress in MiB, and warnings.
        timeout_s: after this long without data the connection counts as broken.
        pause_s: wait before a broken connection, if it brought anything, is tried again.

    Raises:
        DownloadError: another process fetches the same file; the server refuses; there is no connection, or it breaks
            and trying again brings nothing; the disk is full or refuses; the sum is wrong (then, and only then, what
            has come is thrown away).
    """
    part = _Part(part_of(target))
    with _only_process(target):
        _fetch_whole(address, part, reporter, timeout_s=timeout_s, pause_s=pause_s)
        reporter.note(f"checking {target.name}")
        found = md5_of(part.path)
        if found != md5:
            part.remove()
            raise DownloadError(
                f"{address}: what came has MD5 {found}, published is {md5}; it was removed. The same command fetches "
                "it again; if that ends the same way, the file there is another one"
            )
        with _disk_errors(target):
            os.replace(part.path, target)
        part.remove()


class _ConnectionBrokenError(Exception):
    """The network failed, for the reason in the text; trying again may help."""


@dataclass(frozen=True, kw_only=True)
class _Version:
    """What the server says of the file it has.

    Args:
        num_bytes: of the whole file.
        validator: strong ETag, else the date of the last change, else empty.
    """

    num_bytes: int
    validator: str

    def may_be(self, other: _Version | None) -> bool:
        """Nothing speaks against them being the same."""
        if other is None or self.num_bytes != other.num_bytes:
            return False
        return self.validator == other.validator or not (self.validator and other.validator)


class _Part:
    """The bytes that have come so far, and the version of the file that they are of; None where that is unknown."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._version_path = path.with_name(f"{path.name}.json")
        self.version: _Version | None = None
        with suppress(OSError, ValueError, TypeError):
            self.version = _Version(**json.loads(self._version_path.read_text(encoding="utf-8")))

    @property
    def num_bytes(self) -> int:
        """Bytes to resume from; those of an unknown version are of no use."""
        return self.path.stat().st_size if self.version and self.path.is_file() else 0

    @property
    def is_whole(self) -> bool:
        """All bytes are there."""
        return self.version is not None and self.num_bytes == self.version.num_bytes

    def begin(self, version: _Version) -> None:
        """Empty, of a version; in this order, so that old bytes never pass for those of a new version."""
        with _disk_errors(self.path):
            self.path.write_bytes(b"")
            self._version_path.write_text(json.dumps(asdict(version)), encoding="utf-8")
        self.version = version

    def remove(self) -> None:
        """As if nothing had come."""
        self.version = None
        with _disk_errors(self.path):
            self.path.unlink(missing_ok=True)
            self._version_path.unlink(missing_ok=True)


def _fetch_whole(address: str, part: _Part, reporter: Reporter, *, timeout_s: float, pause_s: float) -> None:
    """Fetch until all is there; a broken connection is tried again for as long as that brings more bytes."""
    while not part.is_whole:
        had = part.num_bytes
        try:
            _fetch_rest(address, part, reporter, timeout_s=timeout_s)
        except _ConnectionBrokenError as broken:
            if part.num_bytes <= had:
                kept = f"; the {had / _MIB:.1f} MiB that have come are kept, the same command goes on there"
                raise DownloadError(
                    f"{address}: {broken}; check the network, the proxy variables (http_proxy, https_proxy) and "
                    f"--base-url, or get the file elsewhere and name it with --weights{kept if had else ''}"
                ) from broken
            reporter.warn(f"{address}: {broken}; trying again")
            time.sleep(pause_s)


def _fetch_rest(address: str, part: _Part, reporter: Reporter, *, timeout_s: float) -> None:
    """One request: append to the part what is missing, or begin it anew if the server has another file."""
    had = part.num_bytes
    with _answer(address, part, timeout_s) as response:
        first_byte, version = _span(address, response)
        if first_byte not in (0, had):
            raise DownloadError(
                f"{address}: asked for the bytes from {had} on, the server sends those from {first_byte} on; {_BY_HAND}"
            )
        if first_byte == 0 or not version.may_be(part.version):
            if had:
                reporter.note(f"{address}: has changed, or comes only as a whole; starting over")
            part.begin(version)
        # The rest of another version is of no use: the part is empty now, and the next request is for everything.
        if first_byte == part.num_bytes:
            _append(response, part, version, reporter)


def _answer(address: str, part: _Part, timeout_s: float) -> requests.Response:
    """What the server says to the request for what is missing: status 200 (everything) or 206 (the rest)."""
    headers = {"User-Agent": f"smust3r-colmap/{__version__}", "Accept-Encoding": "identity"}
    if part.num_bytes:
        headers["Range"] = f"bytes={part.num_bytes}-"
        if part.version and part.version.validator:
            headers["If-Range"] = part.version.validator
    try:
        response = requests.get(address, headers=headers, stream=True, timeout=timeout_s)
    except requests.RequestException as error:
        raise _ConnectionBrokenError(f"no connection ({_cause(error)})") from error
    if response.ok:
        return response
    response.close()
    if response.status_code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and part.num_bytes:
        part.remove()  # the file there is shorter now
        return _answer(address, part, timeout_s)
    status = f"{response.status_code} {response.reason}"
    raise DownloadError(f"{address}: the server answers {status}; {_advice(response.status_code)}")


def _span(address: str, response: requests.Response) -> tuple[int, _Version]:
    """Where the bytes that follow begin in the file, and the version of the file.

    Raises:
        DownloadError: it is a page for people, as networks send that want a log-in first, or the server does not say
            how long the file is.
    """
    if response.headers.get("Content-Type", "").startswith("text/html"):
        raise DownloadError(f"{address}: what comes is a web page (a log-in of the network?); {_BY_HAND}")
    if response.status_code == HTTPStatus.PARTIAL_CONTENT:
        match = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers.get("Content-Range", ""))
        first_byte, num_bytes = (int(match[1]), int(match[2])) if match else (0, 0)
    else:
        length = response.headers.get("Content-Length", "")
        first_byte, num_bytes = 0, int(length) if length.isdecimal() else 0
    if num_bytes == 0:
        raise DownloadError(f"{address}: the server does not say how long the file is; {_BY_HAND}")
    tag = response.headers.get("ETag", "")
    # If-Range does not take weak tags: they call files equal whose bytes differ.
    validator = response.headers.get("Last-Modified", "") if not tag or tag.startswith("W/") else tag
    return first_byte, _Version(num_bytes=num_bytes, validator=validator)


def _append(response: requests.Response, part: _Part, version: _Version, reporter: Reporter) -> None:
    """Write the bytes of the response behind those of the part, telling of each MiB."""
    done = part.num_bytes
    _check_space(part.path, missing=version.num_bytes - done)
    total_mib = -(-version.num_bytes // _MIB)
    with (
        reporter.stage(f"{part.path.stem}, MiB", total=total_mib) as stage,
        _disk_errors(part.path),
        part.path.open("ab") as file,
    ):
        done_mib = done // _MIB
        stage.skip(done_mib)
        for block in _blocks(response):
            file.write(block)
            done += len(block)
            now_mib = total_mib if done == version.num_bytes else done // _MIB
            stage.advance(now_mib - done_mib)
            done_mib = now_mib
        file.flush()
        os.fsync(file.fileno())
    if done < version.num_bytes:
        raise _ConnectionBrokenError("the connection ended before the file did")


def _blocks(response: requests.Response) -> Iterator[bytes]:
    """The bytes of the response, as they come."""
    try:
        yield from response.iter_content(_BLOCK_BYTES)
    except requests.RequestException as error:
        raise _ConnectionBrokenError(f"the connection broke ({_cause(error)})") from error


def _check_space(path: Path, *, missing: int) -> None:
    with _disk_errors(path):
        free = shutil.disk_usage(path.parent).free
    if missing > free:
        raise DownloadError(
            f"{path.parent}: {missing / _MIB:.1f} MiB are missing and the disk has {free / _MIB:.1f} MiB free; "
            f"{_OTHER_DISK}"
        )


@contextmanager
def _only_process(target: Path) -> Iterator[None]:
    """Hold the file's lock, or refuse."""
    lock = FileLock(target.with_name(f".{target.name}.lock"))
    with _disk_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            raise DownloadError(f"{target}: another process is fetching it; wait for it or stop it") from None
    try:
        yield
    finally:
        lock.release()


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    """Turn what the disk refuses into a DownloadError with the way out."""
    try:
        yield
    except OSError as error:
        raise DownloadError(f"{path}: {error.strerror or error}; what has come is kept; {_OTHER_DISK}") from error


def _advice(status: int) -> str:
    """What to do about an answer that is a refusal."""
    if status in (HTTPStatus.NOT_FOUND, HTTPStatus.GONE):
        return f"check --base-url, or {_BY_HAND}"
    if status == HTTPStatus.TOO_MANY_REQUESTS or status >= HTTPStatus.INTERNAL_SERVER_ERROR:
        return "what has come is kept, try again later"
    return f"the server or a proxy does not let this program in: {_BY_HAND}"


def _cause(error: BaseException) -> str:
    """The first reason in words; requests wraps those of urllib3, which wraps those of the system."""
    while error.__context__ is not None:
        error = error.__context__
    return str(error) or type(error).__name__
