"""Worker processes that end with the process that started them, however that ends."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor


@contextlib.contextmanager
def pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes. An exception in the body, such as Ctrl-C, ends them at once."""
    # spawn: threads of other libraries do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _end_with_parent) as workers:
        try:
            yield workers
        except BaseException:
            # Leaving the pool waits for its tasks, which may take hours.
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _end_with_parent() -> None:
    """Watches the parent in a thread: a pool does not tell its workers that it was killed."""
    # Ctrl-C reaches the whole process group; the parent ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_watch, name="parent", daemon=True).start()


def _watch() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # a worker is started by a pool
    parent.join()
    # Nobody waits for the result. A file that is being written keeps its name of a partial file.
    os._exit(1)
