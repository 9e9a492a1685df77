"""Parameters that a paper does not print, fitted to what it does.

`python -m trackwright.experiments.lab.papers.fitting NAME`: what `fit` of a study's file, such as
papers/kwon_2021/table_4, returns is written to `fitted/table_4.toml` beside it, where the study reads it.
"""

import importlib
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tomli_w
from scipy.optimize import least_squares

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.lab.papers.declared import Printed
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.files import atomic_write

LAB = Path(__file__).parents[1]
STEP = 0.05  # of the forward differences by log parameters


class Fitted(NamedTuple):
    """A fitted parameter: value, or where its search starts; unit; and the printed results that it is fitted to."""

    value: float
    unit: str
    to: str


@dataclass(frozen=True)
class Fit:
    """A fit of a study's parameters: of every group in `to` our numbers equal the printed ones, in geometric mean.

    `free`: the parameters, numbers of the study's worlds, or tracker and tunable by `tunables`. `left`: the degrees of
    freedom left, in words. `rounds`: most steps of the search. `seed`: other than the study's.
    """

    study: mc.Study
    free: Mapping[str, Fitted]
    to: Sequence[Sequence[Printed]]
    left: str
    runs: int
    rounds: int = 3
    seed: int = 0
    tunables: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    def ratios(self, numbers: Mapping[str, float]) -> np.ndarray:
        """Our numbers over the printed ones, a geometric mean for each group."""
        figures = [figure for group in self.to for figure in group]
        worlds = {world: self.study.worlds[world] for figure in figures for world in figure.worlds}
        trackers = {figure.tracker: self.study.trackers[figure.tracker] for figure in figures}
        for name, world in worlds.items():
            worlds[name] = replace(world, numbers={k: numbers.get(k, value) for k, value in world.numbers.items()})
        for name, config in trackers.items():
            values = {tunable: numbers[k] for k, (tracker, tunable) in self.tunables.items() if tracker == name}
            trackers[name] = replace(config, tunables={**config.tunables, **values})
        few = replace(self.study, worlds=worlds, trackers=trackers, metrics=(), runs=self.runs, seed=self.seed)
        results = unsaved(few)
        return np.exp([np.mean([np.log(p.ours(results).value / p.number) for p in group]) for group in self.to])

    def __call__(self) -> tuple[str, dict[str, Fitted]]:
        """The degrees of freedom left and the fitted parameters."""
        optimum = solved(self.ratios, {name: start.value for name, start in self.free.items()}, self.rounds)
        return self.left, {name: start._replace(value=optimum[name]) for name, start in self.free.items()}


def solved(
    ratios: Callable[[dict[str, float]], np.ndarray], start: Mapping[str, float], rounds: int = 6
) -> dict[str, float]:
    """The positive parameters at which the `ratios` (m,) of simulated to printed results are closest to one.

    Least squares of the ratios' logarithms over the parameters' logarithms, with forward differences over 5 %, until a
    step is below a thousandth or after `rounds` steps. Seeded runs make the ratios smooth functions of the parameters.
    """

    def numbers(shifted: np.ndarray) -> dict[str, float]:
        return dict(zip(start, (begin * np.exp(shifted - 1.0)).tolist(), strict=True))

    # Log parameters are shifted to one at the start, so that the relative step of the differences is STEP.
    begin = np.array(list(start.values()), float)
    optimum = least_squares(
        lambda x: np.log(ratios(numbers(x))), np.ones(len(begin)), diff_step=STEP, xtol=1e-3, max_nfev=rounds + 1
    )
    return numbers(optimum.x)


def unsaved(study: mc.Study) -> mc.Results:
    """The results of a study whose chunks are not kept."""
    with tempfile.TemporaryDirectory() as folder:
        results = mc.run_study(study, Path(folder))
    assert results is not None
    return results


def fitted(name: str) -> dict[str, float]:
    """The parameters of a fit by its name, such as `papers/will_2020/table_1`."""
    content = tomllib.loads(fitted_file(name).read_text("utf-8"))
    return {number: table["value"] for number, table in content["numbers"].items()}


def fitted_file(name: str) -> Path:
    """The file of a fit: `papers/will_2020/table_1` is papers/will_2020/fitted/table_1.toml."""
    study = LAB / name
    return study.parent / "fitted" / f"{study.name}.toml"


def write_fitted(name: str, left: str, numbers: Mapping[str, Fitted]) -> Path:
    """Write the parameters of a fit, to four digits; `left`: the degrees of freedom left, in words."""
    table = {
        "degrees_of_freedom_left": left,
        "numbers": {
            number: {"value": float(f"{value:.4g}"), "unit": unit, "fitted_to": to}
            for number, (value, unit, to) in numbers.items()
        },
    }
    text = f"# Written by `python -m trackwright.experiments.lab.papers.fitting {name}`.\n{tomli_w.dumps(table)}"
    return atomic_write(fitted_file(name), lambda temporary: temporary.write_text(text, encoding="utf-8"))


def main(name: str) -> None:
    """Fit the parameters of a study and write their file.

    Args:
        name: path of the study's file below experiments/lab, without `.py`.
    """
    known = sorted(str(file.relative_to(LAB).with_suffix("")) for file in LAB.rglob("fitted/*.toml"))
    known = [file.replace("/fitted/", "/") for file in known]
    if name not in known:
        raise UnusableInput(f"fit '{name}': unknown; expected one of {', '.join(known)}")
    left, numbers = importlib.import_module(f"trackwright.experiments.lab.{name.replace('/', '.')}").fit()
    print(f"wrote {write_fitted(name, left, numbers)}")


if __name__ == "__main__":
    run_alone(main, "python -m trackwright.experiments.lab.papers.fitting")
