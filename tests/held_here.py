"""A stand-in for Dask's client: calls and results are pickled, and what was loaded is lost after every use."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from concurrent import futures
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from trackwright.experiments.jobs.environment import environment


@dataclass(frozen=True)
class Held:
    """A submitted call, made whenever its result is needed."""

    function: Any
    expected: Any
    call: bytes

    def result(self) -> Any:
        """What the call returns, as it would travel."""
        return pickle.loads(pickle.dumps(self.function(self.expected, self.call)))


class Client:
    """What a fit uses of `distributed.Client`, and its executor; `results`: of all calls of the executor."""

    def __init__(self) -> None:
        self.results = list[Any]()

    def submit(self, function: Any, expected: Any, call: bytes, *, key: str, pure: bool) -> Held:
        """What stays with a worker."""
        return Held(function, expected, call)

    def get_executor(self, pure: bool) -> Executor:
        """An executor that computes at once, here."""
        return Executor(self)


class Executor(futures.Executor):
    """An executor that computes at once."""

    def __init__(self, client: Client) -> None:
        self.client = client

    def submit(self, function: Any, /, *args: Any, **kwargs: Any) -> futures.Future[Any]:
        """The future of a call, which has its result already."""
        future = futures.Future[Any]()
        here = [one.result() if isinstance(one, Held) else one for one in args]
        try:
            future.set_result(pickle.loads(pickle.dumps(function(*here, **kwargs))))
            self.client.results.append(future.result())
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def client_here(cluster: str) -> Iterator[tuple[Client, dict[str, Any]]]:
    """In place of `cluster_client`."""
    yield Client(), environment()
