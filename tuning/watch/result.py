"""What a watch found: whether the site has changed, what, when, by how much, and what to do; and its text."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import numpy as np

from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import WIDTH
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.watch.causes import WORDS, Cause
from trackwright.tuning.watch.parity import Blocks
from trackwright.tuning.watch.readings import SLOT_S, times_of
from trackwright.tuning.watch.sequential import Course
from trackwright.tuning.watch.site import Site

UNDECIDED = 3.0
"""Difference of scores, about odds of 20, up to which causes are not told apart."""


@dataclass(frozen=True, eq=False)
class Watch:
    """A watch over runs.

    `starts`: when each run begins on the common time, s; `blocks` and `course`: of the test; `causes`: of the first
    alarm, the likeliest first, none without one. `unseen`: the share of the blocks at places that the baseline lacks.
    """

    site: Site
    runs: tuple[RecordingFolder, ...]
    starts: np.ndarray
    blocks: Blocks
    course: Course
    causes: tuple[Cause, ...]
    unseen: float
    alarms_a_day: float
    new: tuple[str, ...]

    @property
    def changed(self) -> bool:
        """Whether there was an alarm."""
        return self.course.alarm is not None

    @property
    def cause(self) -> Cause | None:
        """The likeliest cause of the first alarm."""
        return self.causes[0] if self.causes else None

    @property
    def alarm_s(self) -> float:
        """When the alarm was given, s on the common time."""
        return SLOT_S * float(self.blocks.slot[self.course.alarm] + 1) if self.changed else np.nan

    @property
    def onset_s(self) -> float:
        """When the change was, s on the common time."""
        return SLOT_S * float(self.cause.onset) if self.cause else np.nan

    def since(self) -> dict[str, float]:
        """The time of each run's readings, s, from which on the site has changed; only of runs in which it has."""
        ends = np.append(self.starts[1:], np.inf)
        return {
            run.name: times_of(run)[0] + max(self.onset_s - start, 0.0)
            for run, start, end in zip(self.runs, self.starts, ends, strict=True)
            if self.onset_s < end
        }

    def half_widths(self, cause: Cause) -> np.ndarray:
        """Those of the 95 % intervals of a cause's sizes: of what was watched, and of the baseline."""
        normal = self.site.normal
        scatter = (cause.unit**2 * normal.scatter[:, None]).sum(axis=0)
        known = cause.unit.T @ normal.information @ cause.unit + 1e-3 * np.eye(len(scatter))
        drift = 0.0 if cause.name == "drift" else np.diag(np.linalg.inv(known))
        return NORMAL * np.sqrt(np.maximum(scatter, cause.scatter) * np.diag(cause.covariance) + scatter * drift)

    def when(self, seconds: float) -> str:
        """A time of the common time axis in words."""
        k = int(np.searchsorted(self.starts, seconds + 1e-6, side="right")) - 1
        return f"{seconds - self.starts[k]:.0f} s after the start of {self.runs[k].name}"

    def size(self, cause: Cause) -> str:
        """The size of a cause with its interval, in words."""
        half = self.half_widths(cause)
        if cause.name == "swapped":
            return ""
        if cause.name == "drift":
            return f"by {60 * cause.size[0]:+.3f} ± {60 * half[0]:.3f} m a minute"
        if cause.name == "moved":
            distance = float(np.linalg.norm(cause.size))
            along = float(np.sqrt(((cause.size / max(distance, 1e-9) * half) ** 2).sum()))
            parts = (f"{axis} {x:+.2f} ± {h:.2f}" for axis, x, h in zip("xyz", cause.size, half, strict=False))
            return f"by {distance:.2f} ± {along:.2f} m ({', '.join(parts)})"
        if cause.sources[0].table == "bearings":
            # Of an obstruction what the azimuths and elevations are off by, in the same words.
            turns = [f"{x:+.1f} ± {h:.1f}°" for x, h in zip(np.degrees(cause.size), np.degrees(half), strict=True)]
            return f"by {turns[0]}" + (f", and its elevations by {turns[1]}" if len(turns) > 1 else "")
        return f"by {cause.size[0]:+.2f} ± {half[0]:.2f} m"

    def what(self, cause: Cause) -> str:
        """A cause in words, with its size."""
        return f"{' and '.join(map(str, cause.sources))} {WORDS[cause.name]} {self.size(cause)}".rstrip()

    def advice(self, cause: Cause) -> str:
        """What to do about a cause."""
        name, rig = cause.sources[0].name, self.site.rig
        noun = str(cause.sources[0])
        match cause.name:
            case "moved":
                place = rig.stations[name].position if cause.sources[0].table == "bearings" else rig.anchors[name]
                there = np.asarray(place, float).copy()
                there[: len(cause.size)] += cause.size
                return (
                    f"put {noun} back, or correct its position in rig.toml to [{', '.join(f'{x:.2f}' for x in there)}]"
                )
            case "swapped":
                return f"exchange {name} and {cause.sources[1].name} in rig.toml, or the devices"
            case "turned":
                return f"turn {noun} back, or correct its rotation_wxyz in rig.toml"
            case "delay":
                return f"calibrate {noun} again: firmware, cable or antenna may be another"
            case "drift":
                return f"check the clock of {noun} and its synchronisation"
        return f"look for a new obstacle between {noun} and {self.places(cause)}"

    def places(self, cause: Cause) -> str:
        """The middles of the places that a cause concerns, in words."""
        cells = self.site.normal.places if cause.places is None else self.site.normal.places[cause.places]
        middles = self.site.cell_m * (cells + 0.5)
        return listed((f"({x:.1f}, {y:.1f})" for x, y in middles), 4)

    @property
    def named(self) -> list[Cause]:
        """The likeliest cause and those nearly as likely, from which the readings do not tell it apart."""
        likely = [cause for cause in self.causes if cause.score > self.causes[0].score - UNDECIDED]
        first = {(cause.name, cause.sources): cause for cause in reversed(likely)}
        return sorted(first.values(), key=lambda cause: -cause.score)

    @property
    def minutes(self) -> float:
        """How long was watched, of all tags together."""
        return SLOT_S * len(np.unique(np.stack([self.blocks.track, self.blocks.slot]), axis=1).T) / 60.0

    def reach(self) -> list[str]:
        """From which size on a change of each source is told, in words."""
        bank = self.site.bank
        lines = []
        for k, source in enumerate(self.site.sources):
            own = bank.least[(bank.source == k) & (bank.place < 0)][0]
            lines.append(
                f"{source.name} {np.degrees(own):.0f}°" if source.table == "bearings" else f"{source.name} {own:.2f} m"
            )
        return lines

    def lines(self) -> list[str]:
        """The verdict, and what it rests on, a line each."""
        stated = f"at most {self.alarms_a_day:g} false alarm{'s' * (self.alarms_a_day != 1)} a day"
        ground = [
            f"watched {self.minutes:.1f} min against {self.site.seconds / 60:.1f} min of normal operation, {stated}; "
            f"smallest change that is told: {', '.join(self.reach())}"
        ]
        if self.unseen > 0.05:
            ground.append(
                f"{100 * self.unseen:.0f} % of it was at places that the baseline has not seen, and not judged"
            )
        if self.new:
            ground.append(f"not in the baseline, and not judged: {listed(self.new)}")
        if not self.changed:
            return ["no change", *ground]
        words = ", or ".join(map(self.what, self.named)) + ", which cannot be told apart" * (len(self.named) > 1)
        verdict = f"changed: {words}, {self.when(self.onset_s)} (alarm {self.when(self.alarm_s)})"
        return [verdict, f"to do: {'; or '.join(map(self.advice, self.named))}", *ground]

    def __str__(self) -> str:
        return "\n".join("\n".join(textwrap.wrap(line, WIDTH, subsequent_indent="  ")) for line in self.lines())

    def __repr__(self) -> str:
        return f"<Watch: {self.lines()[0]}>"
