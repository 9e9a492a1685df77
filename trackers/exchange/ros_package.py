"""The optional package rosbags, which reads and writes bags of ROS 1 and ROS 2 without ROS."""

from __future__ import annotations

from types import ModuleType

from trackers.core.errors import UnusableInput


def rosbags_module(name: str, what: str) -> ModuleType:
    """The module `rosbags.NAME`; raises UnusableInput, which names the extra, where the package is missing."""
    from importlib import import_module

    try:
        return import_module(f"rosbags.{name}")
    except ImportError:
        raise UnusableInput(
            f"{what} needs the package rosbags; install the extra: pip install 'trackwright[ros]'"
        ) from None
