"""Freed memory goes back to the system, and other systems than Linux are left alone."""

import ctypes
import sys

import pytest

from trackers.core.freed_memory import give_back


def test_memory_is_given_back_where_glibc_can(monkeypatch):
    calls = []

    class Library:
        def malloc_trim(self, padding):
            calls.append(padding)

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Library())
    monkeypatch.setattr(sys, "platform", "linux")
    give_back()
    monkeypatch.setattr(sys, "platform", "darwin")
    give_back()
    assert calls == [0]


@pytest.mark.parametrize("error", [OSError, AttributeError])
def test_a_library_without_the_call_is_no_error(monkeypatch, error):
    def missing(name):
        raise error

    monkeypatch.setattr(ctypes, "CDLL", missing)
    monkeypatch.setattr(sys, "platform", "linux")
    give_back()
