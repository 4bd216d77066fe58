"""Fitting members on the workers of a cluster, by dask.distributed (the extra `cluster`).

Where a worker sees the run directory (a shared file system), it works in it: a member whose worker is lost goes on from
its last checkpoint on another. Where it does not, the worker keeps its files to itself, and they come back with the
result; a lost member then begins anew. Either way the numbers are those of a run in one process.
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
"""A file in `members/` by which a worker knows that it sees the run directory."""

Files = dict[str, bytes]


@contextmanager
def cluster(address: str, threads: int) -> Iterator[Workers]:
    """The cluster of the scheduler at `address`. Raises UserError (GB860) where there is none, or dask is missing."""
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
"""The library `distributed`, which may be absent, and objects of it."""


def _distributed() -> Distributed:
    """The library, which is no requirement of gbspec."""
    return importlib.import_module("distributed")


class _Cluster:
    """The engine; a name of its own keeps several runs on one scheduler apart."""

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
        # Whatever a member that this very run lost has written is there to be gone on from.
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
        except Exception as error:  # whatever went wrong on the cluster or on the way to it
            what = f"{job.name} was lost on the cluster: {type(error).__name__}: {error}"
            raise ComputationError(what, remedy="`--resume` continues the run, with or without a cluster") from None
        for name, content in written.items():
            files.write_bytes(job.place / name, content)
        found: MemberResult | None = result
        return found

    def stop(self) -> None:
        self.stopped.set()

    def forget(self) -> None:
        """Takes back what is on the scheduler and in the run directories only while jobs run."""
        self.client.unsubscribe_topic(self.name)
        for token in self.tokens:
            token.unlink(missing_ok=True)


# -------------------------------------------------------------------------------------------------- on a worker
def _work(job: Job, kept: Files, name: str, threads: int, version: str) -> tuple[MemberResult | None, Files]:
    """One member; with its files, unless the caller sees them anyway. Raises ComputationError as training does."""
    worker = _distributed().get_worker()
    if version != __version__:
        what = f"the worker has gbspec {__version__}, but {version} asked for the fit"
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
    """Whether the caller has told all to stop, asked of the scheduler at most once a second."""
    event, asked, last = _distributed().Event(name), [float("-inf")], [False]

    def stopped() -> bool:
        if time.monotonic() - asked[0] > 1.0:
            last[0] = bool(event.is_set())
            asked[0] = time.monotonic()
        return last[0]

    return stopped


@contextmanager
def _workplace(job: Job, kept: Files, name: str) -> Iterator[tuple[Path, bool]]:
    """Where the worker keeps the member's files, and whether that is the caller's run directory."""
    token = job.place.parent / TOKEN
    if token.is_file() and token.read_text(encoding="utf-8") == name:
        yield job.place, True
        return
    with TemporaryDirectory(prefix="gbspec-") as scratch:
        for file, content in kept.items():
            (Path(scratch) / file).write_bytes(content)
        yield Path(scratch), False


def _contents(place: Path) -> Files:
    """The files of a member by name (none of them in a folder; half-written ones are hidden)."""
    if not place.is_dir():
        return {}
    return {p.name: p.read_bytes() for p in place.iterdir() if p.is_file() and not p.name.startswith(".")}
