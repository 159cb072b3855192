"""The requests of all visitors. They run one at a time because only one set of networks is in memory."""

from __future__ import annotations

import logging
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import takewhile
from typing import Any

from lp_framework.errors import UserError
from lp_framework.solvers.progress import progress_in

log = logging.getLogger(__name__)

KEPT = 256  # requests whose results can still be fetched


class Cancelled(UserError):
    """The visitor cancelled the request."""


class Job:
    """A request: its progress, warnings and result."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._work = work
        self.step, self.done, self.total = "", 0, 0
        self.warnings: list[str] = []
        self.cancelled = False
        self.future: Future[Any]

    def track(self, sequence: range, *, description: str) -> Iterator[int]:
        """See `progress.Bars`; raises `Cancelled` before the next step if the request was cancelled."""
        self.step, self.total = description, len(sequence)
        for self.done, each in enumerate(sequence):
            if self.cancelled:
                raise Cancelled("cancelled")
            yield each

    def run(self) -> Any:
        """Run the request and return its result."""
        if self.cancelled:
            raise Cancelled("cancelled")
        noted = Noted(self.warnings)
        logging.getLogger().addHandler(noted)
        try:
            with progress_in(self):
                return self._work()
        finally:
            logging.getLogger().removeHandler(noted)

    @property
    def share(self) -> float:
        """The completed fraction of the current step, in [0, 1]."""
        return self.done / self.total if self.total else 0.0


class Noted(logging.Handler):
    """Collects the warnings logged by the thread that created it."""

    def __init__(self, warnings: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._warnings, self._thread = warnings, threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            self._warnings.append(record.getMessage())


class Jobs:
    """Runs requests one at a time in one thread. Requests have unguessable names."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lp-app")
        self._jobs: OrderedDict[str, Job] = OrderedDict()  # the most recently fetched one is last
        self._lock = threading.Lock()  # of the order

    def submit(self, work: Callable[[], Any]) -> str:
        """Queue a request and return its name."""
        name, job = secrets.token_urlsafe(16), Job(work)
        with self._lock:
            job.future = self._thread.submit(job.run)
            self._jobs[name] = job
            for old in [each for each, other in self._jobs.items() if other.future.done()][:-KEPT]:
                del self._jobs[old]
        return name

    def now(self, work: Callable[[], Any]) -> Any:
        """Run a short request and return its result."""
        return self.result(self.submit(work))

    def cancel(self, name: str | None) -> None:
        """Cancel a request before its next step; does nothing if there is no request of that name."""
        if name is not None and name in self._jobs:
            self._jobs[name].cancelled = True

    def state(self, name: str) -> tuple[float, str]:
        """The completed fraction of a request's current step, and a description for the visitor."""
        job = self._jobs.get(name)
        if job is None or job.future.done():
            return 1.0, ""
        if not job.future.running():
            with self._lock:
                earlier = takewhile(lambda each: each is not job, self._jobs.values())
                waiting = sum(not each.future.done() for each in earlier)
            return 0.0, f"{waiting} request{'' if waiting == 1 else 's'} before this one"
        count = f" {job.done + 1} of {job.total}" if job.total else ""
        return job.share, f"{job.step}{count}" or "loading"

    def is_done(self, name: str) -> bool:
        """Whether a request has finished, failed or been cancelled."""
        return name not in self._jobs or self._jobs[name].future.done()

    def result(self, name: str) -> Any:
        """Wait for a request's result; `UserError` with a sentence for the visitor if it failed."""
        if name not in self._jobs:
            raise UserError("the app no longer has the answer to this request; please send it once more")
        try:
            found = self._jobs[name].future.result()
            with self._lock:
                self._jobs.move_to_end(name)
            return found
        except UserError:
            raise
        except Exception as error:
            log.exception("a request failed")
            raise UserError(
                f"something went wrong ({type(error).__name__}: {error}); the log has the details"
            ) from error

    def warnings(self, name: str) -> list[str]:
        """The warnings logged during a request."""
        return self._jobs[name].warnings

    def close(self) -> None:
        """Cancel all requests and wait for the current step to end."""
        for job in self._jobs.values():
            job.cancelled = True
        self._thread.shutdown(cancel_futures=True)
