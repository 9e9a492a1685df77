"""The command that sets default noise levels: its objective, its levels, and that it finds better ones."""

import numpy as np
import pytest

from trackwright.experiments.lab.validation.default_levels import KINDS, Objective
from trackwright.trackers.catalogue import build
from trackwright.trackers.evaluation.evaluate import associate
from trackwright.trackers.evaluation.scoring import covariances
from trackwright.trackers.recordings.folder import read_recordings


@pytest.mark.parametrize("kind", KINDS)
def test_levels_are_keywords_of_the_builder_with_the_present_defaults(kind):
    levels = KINDS[kind]
    values = levels.values()
    assert set(values) == set(levels.names)
    assert all(np.all(np.asarray(value) > 0) for value in values.values())


@pytest.mark.slow
def test_the_objective_is_the_mean_log_density_of_the_true_positions_over_the_floor(recordings):
    folders = read_recordings([recordings / f"ble51-walk-u{k}-r1" for k in (1, 2)])
    objective = Objective(KINDS["bearings"], folders)
    found = objective.by_recording(objective.start())
    for folder in folders:
        pairs = associate(build("bearings", folder).run(folder), folder)
        rows = pairs.rows.filter(pairs.scored)
        errors = (rows.select("x_m", "y_m").to_numpy() - pairs.truth[pairs.scored][:, :2])[:, :, None]
        covs = covariances(rows)[:, :2, :2]
        nees = (errors.mT @ np.linalg.inv(covs) @ errors).ravel()
        expected = np.mean(0.5 * nees + 0.5 * np.log(np.linalg.det(2 * np.pi * covs)))
        assert found[folder.name] == pytest.approx(expected, rel=1e-4)
    assert objective(objective.start()) == pytest.approx(np.mean(list(found.values())))
