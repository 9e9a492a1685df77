"""Workers, in threads, that some parts of a job end, as those of Dask that run out of memory."""

from concurrent.futures import Future

from trackwright.experiments.jobs.executors import WorkerExecutor


class KilledWorker(Exception):  # noqa: N818 - the name in Dask
    pass


class Deadly(WorkerExecutor):
    """Workers that the parts end for which `ends` is true."""

    def __init__(self, threads, environment, ends):
        super().__init__(threads, environment)
        self.ends = ends

    def submit(self, function, *rest):
        if not self.ends(rest[-1]):
            return super().submit(function, *rest)
        ended = Future()
        ended.set_exception(KilledWorker(str(rest[-1])))
        return ended
