"""Evaluations as text: what an archive's medians are of."""

from __future__ import annotations

from dataclasses import replace

import trackwright as tw
from trackwright.experiments.text.evaluation_text import archive_text


def test_the_medians_of_an_archive_are_of_the_recordings_with_truth():
    folders = [replace(tw.simulate.agv(1, k, rows=60).folder(), name=f"hall {k}") for k in range(3)]
    tracks = tw.build("fix-kf", folders).run(folders)
    text = archive_text(tw.evaluate(tracks.table, folders[:1]))
    assert "median of 1" in text
    assert "hall 0" in text
    assert "hall 1" not in text
