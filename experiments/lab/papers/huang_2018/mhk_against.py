"""MH-K compared with Singer's model, an IMM and a plain Kalman filter, and with itself without its Markov chain.

The world of `workshop` as fitted there, and the same at a constant 1.2 m/s, where corners of 1 m radius take 1.4 m/s².
All differences are paired: same vehicles, same errors. The competitors run with their default parameters; tuned ones
might be closer.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx

from experiments.lab.papers.fitting import fitted
from experiments.lab.papers.huang_2018.workshop import MEASURES, workshop
from experiments.monte_carlo import PREDICTED, Conclusion, ExpectedResult, Results, Study, TrackerConfig, Value, World
from experiments.text.wording import fixed_interval
from trackers.core.ekf import ExtendedKalman
from trackers.mhk.rows import TRACKERS
from trackers.mhk.tracker import mhk_tracker
from trackers.recordings.tracker_spec import TrackerSpec

NUMBERS = fitted("huang_2018/workshop")
NOISE = {name: NUMBERS[name] for name in ("drift", "share", "size")}
SIGMA_A = 0.3
"""m/s² per √Hz; that of the workshop's figures, chosen for the printed mean, would be too low for 1.2 m/s."""

MHK = {"fusion.motion.sigma_a": SIGMA_A}
CLOSER_M = 0.007
CLOSER = MHK | {"fusion.filter.sigma_displacement": CLOSER_M}
WORTH_MM = 0.1
"""An improvement of a hundredth of the smallest standard deviation of a fix, 0.8 cm."""

WORLDS = {"0.5 m/s": 0.5, "1.2 m/s": 1.2}


NOISES = {"5 cm": "", "0.7 cm": ", 0.7 cm"}
"""Noise of a displacement, which the paper does not print, and the suffix of its trackers.

The default, and the standard deviation along x of the difference of two successive medians of a tag at rest.
"""


def _mhk(about: str, chain: bool = True, rate: float | None = None) -> TrackerSpec:
    """MH-K with a chain whose accelerations last 1/`rate` s, or without a chain."""
    made = mhk_tracker(rate=rate, stamped=True)
    if not chain:
        made = eqx.tree_at(lambda t: t.fusion.filter, made, ExtendedKalman())
    return replace(TRACKERS["mhk-stamped"], about=about, build=lambda trajectory, planar: made)


CONFIGS = {
    "mhk-stamped": TrackerConfig("mhk-stamped", MHK),
    "mhk": TrackerConfig("mhk", MHK),
    "no chain": TrackerConfig(_mhk("MH-K without its Markov chain: median and Kalman filter", chain=False), MHK),
    "sticky chain": TrackerConfig(_mhk("MH-K with accelerations that last a second", rate=1.0), MHK),
    "mhk-stamped, 0.7 cm": TrackerConfig("mhk-stamped", CLOSER),
    "sticky chain, 0.7 cm": TrackerConfig(_mhk("MH-K with accelerations that last a second", rate=1.0), CLOSER),
    "fix-kf": TrackerConfig("fix-kf"),
    "fix-singer": TrackerConfig("fix-singer"),
    "imm": TrackerConfig("imm"),
}


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """What the chain adds, and what else a drifting fix can be followed with."""
    found: list[ExpectedResult | Conclusion] = []
    for world in WORLDS:
        added = {noise: _added(results, world, suffix) for noise, suffix in NOISES.items()}
        found.append(
            Conclusion(
                f"at {world} the Markov chain improves no error by {WORTH_MM:g} mm, and adds to it with less noise",
                min(v.low for values in added.values() for v in values.values()) > -WORTH_MM
                and all(added["0.7 cm"][name].low > value.high for name, value in added["5 cm"].items()),
                "with less without: "
                + "; ".join(
                    f"noise of a displacement {noise}: " + ", ".join(f"{_text(v)} {name}" for name, v in values.items())
                    for noise, values in added.items()
                ),
                PREDICTED,
            )
        )
        for other in ("fix-kf", "fix-singer", "imm"):
            route = _mm(results.difference("route_mean_m", world, "mhk", other))
            time = _mm(results.difference("mean_m", world, "mhk", other))
            found.append(
                Conclusion(
                    f"at {world} MH-K is nearer to the route than {other}, but in time further off",
                    route.high < 0 < time.low,
                    f"MH-K less {other}: {_text(route)} to the route, {_text(time)} in time",
                    PREDICTED,
                )
            )
    return found


def _added(results: Results, world: str, suffix: str) -> dict[str, Value]:
    """The differences, mm, of MH-K with its chain from MH-K without, by error."""
    with_chain = f"mhk-stamped{suffix}"
    return {
        "to the route": _mm(results.difference("route_mean_m", world, with_chain, "no chain")),
        "at most": _mm(results.difference("route_max_m", world, with_chain, "no chain")),
        "in time": _mm(results.difference("mean_m", world, with_chain, "no chain")),
        "in time with a sticky chain": _mm(results.difference("mean_m", world, f"sticky chain{suffix}", "no chain")),
    }


def _mm(value: Value) -> Value:
    return value.times(1e3)


def _text(mm: Value) -> str:
    return fixed_interval(mm, "+.2f", " mm")


STUDY = Study(
    name="mhk-against",
    about="MH-K against Singer's model, interacting models and a plain Kalman filter, and without its Markov chain",
    worlds={name: World(workshop, {**NOISE, "speed": speed}) for name, speed in WORLDS.items()},
    trackers=CONFIGS,
    runs=50,
    measures={name: MEASURES[name] for name in ("route_mean_m", "route_max_m", "improved")},
    metrics=("route_mean_m", "route_max_m", "mean_m", "rmse_m", "us_per_row"),
    expected=expected,
)
