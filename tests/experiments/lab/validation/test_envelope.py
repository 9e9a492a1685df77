"""Single beside double precision at the edge: corners of the envelope, and that a wrong estimate is found."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from trackwright.experiments.lab.validation.envelope import (
    NONSENSE,
    ROOMS,
    SIGMAS,
    STEPS,
    SUBJECTS,
    Run,
    judged,
    table,
    verdicts,
)
from trackwright.experiments.lab.validation.envelope_worlds import Cell, recorded
from trackwright.trackers.core.data.estimates import Status

CORNERS = [Cell(*one) for one in product((1e-6, 1.0), (0.0, 1.0, 1e6), (10.0, 1e5))]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fix-kf"])
def test_no_corner_of_the_envelope_is_silent_nonsense(name):
    found, off = verdicts(name, CORNERS, tags=12)
    assert [str(cell) for cell, verdict in found.items() if verdict.words.startswith(NONSENSE)] == []
    assert found[Cell(1.0, 1.0, 10.0)].words == "agrees"
    assert found[Cell(1.0, 1.0, 10.0)].difference < 0.01
    assert off < 1e-6


WRONG = {"uwb-imu": [Cell(0.001, 0.001, 0.01)]}
"""The cells that docs/envelope.md names."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SUBJECTS)
def test_no_other_cell_of_the_envelope_is_silent_nonsense(name):
    # A grid of a room of 1 km takes half a minute in every cell.
    every = [Cell(*one) for one in product(SIGMAS, STEPS, ROOMS)]
    found, _ = verdicts(name, [cell for cell in CORNERS if cell.room <= 10.0] if name == "line-grid" else every)
    assert [cell for cell, verdict in found.items() if verdict.words.startswith(NONSENSE)] == WRONG.get(name, [])


def _run(position, sigma, status=Status.OK):
    shape = np.shape(position)
    statuses = np.full(shape, status)
    usable = statuses == Status.OK
    return Run(
        np.asarray(position, float)[..., None], np.full((*shape, 1), sigma), np.zeros((*shape, 1)), statuses, usable
    )


RIGHT, OFF = [0.0, 0.1], [50.0, 51.0]


@pytest.mark.parametrize(
    ("single", "double", "words"),
    [
        (_run([[0.1, 0.2]], 1.0), _run([RIGHT], 1.0), "agrees"),
        (_run([[0.1, 0.2]], 9.0), _run([RIGHT], 1.0), "coarser"),
        (_run([[0.1, 5.0]], 1.0), _run([RIGHT], 1.0), "differs"),
        (_run([[0.1, 5.0], *[RIGHT] * 39], 1.0), _run([RIGHT] * 40, 1.0), "agrees"),
        (_run([OFF, *[RIGHT] * 39], 1.0), _run([RIGHT, OFF, *[RIGHT] * 38], 1.0), "agrees"),
        (_run([*[OFF] * 15, *[RIGHT] * 25], 1.0), _run([RIGHT] * 40, 1.0), NONSENSE),
        (_run([*[OFF] * 15, *[RIGHT] * 25], 1.0), _run([*[RIGHT] * 25, *[OFF] * 15], 1.0), "agrees"),
        (_run([OFF] * 15, 1.0), _run([RIGHT] * 15, 1.0, Status.LOST), NONSENSE),
        (_run([[0.1, np.nan]], 1.0), _run([RIGHT], 1.0), NONSENSE),
        (_run([[0.1, 0.2]], 0.0), _run([RIGHT], 1.0), NONSENSE),
        (_run([[np.nan, np.nan]], 1.0, Status.NON_FINITE), _run([RIGHT], 1.0), "non-finite"),
        (_run([OFF], 1.0), _run([[50.0, 50.5]], 1.0), "off the model"),
    ],
)
def test_a_cell_is_judged_by_double_precision_and_the_truth(single, double, words):
    assert judged(single, double).words.startswith(words)


def test_a_table_has_the_worst_of_all_time_steps():
    cells = {Cell(1.0, dt, 10.0): judged(_run([[x]], 1.0), _run([[0.0]], 1.0)) for dt, x in ((0.0, 0.1), (1.0, 0.3))}
    assert table(cells) == [{"σ of a reading": "1", "10 m": "agrees 0.3"}]


@pytest.mark.parametrize("name", ["fixes", "mirrored", "path", "ranges", "imu", "bearings"])
def test_a_recording_of_the_envelope_has_the_noise_that_it_is_asked_for(name):
    folder, walks = recorded(Cell(0.01, 1.0, 10.0), name, 40)
    measured = next(iter(folder.tables))
    rows = folder.tables[measured]
    assert rows["tag"].n_unique() == 40
    inside = (walks.begin >= 0) & (walks.begin <= 10)
    assert inside.all()
    if measured == "fixes":
        truth = np.array(
            [walks.begin[int(t)] + walks.velocity[int(t)] * s for t, s in zip(rows["tag"], rows["t_s"], strict=True)]
        )
        assert np.std(rows["x_m"].to_numpy() - truth[:, 0]) == pytest.approx(0.01, rel=0.1)
