"""Fitting members on the workers of a cluster, by dask.distributed (the extra `cluster`).

A worker that can access the run directory (on a shared file system) uses it, and a member whose worker is lost
continues from its last checkpoint on another worker. Otherwise the worker keeps its files locally and returns them with
the result; a lost member is then restarted. In both cases the numbers are the same as those of a run in one process.
"""

from __future__ import annotations

import importlib
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from queue import Queue
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

from gbspec.diagnostics import ComputationError, Diagnostic, UserError
from gbspec.json_values import JsonObject
from gbspec.runs import files
from gbspec.training.optimise import use_threads
from gbspec.training.progress import Update
from gbspec.training.runs.jobs import Job, Pending, Sender, Workers, fit
from gbspec.training.runs.member import Interrupted
from gbspec.training.runs.summary import MemberResult
from gbspec.version import __version__

PATIENCE = 10
"""Seconds to wait for the scheduler's answer."""
TOKEN = ".shared"
"""A file in `members/` by which a worker recognises the run directory."""

Files = dict[str, bytes]


@contextmanager
def cluster(address: str, threads: int) -> Iterator[Workers]:
    """The cluster of the scheduler at `address`. Raises UserError (GB860) if there is none, or dask is missing."""
    try:
        distributed = _distributed()
    except ImportError:
        message = "`--scheduler` needs dask.distributed, which is not installed"
        raise UserError([Diagnostic("GB860", message, None, help="`pip install 'gbspec[cluster]'`")]) from None
    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        message = f"no scheduler answers at `{address}`: {error}"
        help_text = "start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`"
        raise UserError([Diagnostic("GB860", message, None, help=help_text)]) from None
    with client:
        engine = _Cluster(client, threads)
        try:
            yield engine
        finally:
            engine.forget()


Distributed: TypeAlias = Any
"""The library, an optional dependency."""


def _distributed() -> Distributed:
    """The library, which is no requirement of gbspec."""
    return importlib.import_module("distributed")


class _Cluster:
    """The workers of a scheduler; a unique name separates several runs on one scheduler."""

    def __init__(self, client: Distributed, threads: int) -> None:
        self.client, self.threads = client, threads
        self.name = f"gbspec-{uuid.uuid4().hex}"
        self.messages: Queue[Update | str] = Queue()
        self.stopped = _distributed().Event(self.name, client=client)
        self.tokens: set[Path] = set()
        client.subscribe_topic(self.name, self._hear)

    def _hear(self, event: tuple[float, JsonObject]) -> None:
        content = event[1]
        self.messages.put(Update(**content["update"]) if "update" in content else content["message"])

    def submit(self, job: Job) -> Pending:
        token = job.place.parent / TOKEN
        files.write_bytes(token, self.name.encode())
        self.tokens.add(token)
        # A member that was lost in this same run continues from the files it has written.
        options = replace(job.options, resume=True)
        local = replace(job, options=options, run=job.run.resolve())
        kept = _contents(job.place) if job.options.resume else {}
        pending: Pending = self.client.submit(
            _work,
            local,
            kept,
            self.name,
            self.threads,
            __version__,
            key=f"{self.name}-{job.number}",
            pure=False,
        )
        return pending

    def outcome(self, pending: Distributed, job: Job) -> MemberResult | None:
        try:
            result, written = pending.result()
        except (ComputationError, UserError):
            raise
        except Exception as error:  # any failure on the cluster or of the connection
            what = f"{job.name} was lost on the cluster: {type(error).__name__}: {error}"
            raise ComputationError(what, remedy="`--resume` continues the run, with or without a cluster") from None
        for name, content in written.items():
            files.write_bytes(job.place / name, content)
        found: MemberResult | None = result
        return found

    def stop(self) -> None:
        self.stopped.set()

    def forget(self) -> None:
        """Removes temporary data from the scheduler and the run directories."""
        self.client.unsubscribe_topic(self.name)
        for token in self.tokens:
            token.unlink(missing_ok=True)


# -------------------------------------------------------------------------------------------------- on a worker
def _work(job: Job, kept: Files, name: str, threads: int, version: str) -> tuple[MemberResult | None, Files]:
    """The result of one member, with its files unless the caller has access to them. Raises ComputationError."""
    worker = _distributed().get_worker()
    if version != __version__:
        what = f"the worker has gbspec {__version__}, but the fit was requested by {version}"
        raise ComputationError(what, where=f"worker {worker.address}", remedy="install one version everywhere")
    stopped = _stopped(name)
    if stopped():
        return None, {}
    use_threads(threads)

    def send(item: Update | str) -> None:
        worker.log_event(name, {"update": asdict(item)} if isinstance(item, Update) else {"message": item})

    with _workplace(job, kept, name) as (place, shared):
        try:
            result = fit(job, Sender(send), stopped, place)
        except Interrupted as interruption:
            result = interruption.result
        return result, {} if shared else _contents(place)


def _stopped(name: str) -> Callable[[], bool]:
    """A function that returns whether the caller has requested a stop; it asks the scheduler at most once a second."""
    event, asked, last = _distributed().Event(name), [float("-inf")], [False]

    def stopped() -> bool:
        if time.monotonic() - asked[0] > 1.0:
            last[0] = bool(event.is_set())
            asked[0] = time.monotonic()
        return last[0]

    return stopped


@contextmanager
def _workplace(job: Job, kept: Files, name: str) -> Iterator[tuple[Path, bool]]:
    """The directory in which the worker keeps the member's files, and whether it is the caller's run directory."""
    token = job.place.parent / TOKEN
    if token.is_file() and token.read_text(encoding="utf-8") == name:
        yield job.place, True
        return
    with TemporaryDirectory(prefix="gbspec-") as scratch:
        for file, content in kept.items():
            (Path(scratch) / file).write_bytes(content)
        yield Path(scratch), False


def _contents(place: Path) -> Files:
    """The files of a member by name (none in a subfolder; names of incomplete ones begin with a dot)."""
    if not place.is_dir():
        return {}
    return {p.name: p.read_bytes() for p in place.iterdir() if p.is_file() and not p.name.startswith(".")}
