"""What a real recording is calibrated on, and at which levels it runs."""

from dataclasses import replace

import pytest

import trackwright as tw
from trackwright.experiments.lab.validation import real_recordings as real
from trackwright.experiments.lab.validation import sites


@pytest.fixture
def drones(tmp_path, monkeypatch):
    """Two recordings of one installation, by names of a site."""
    for k in (8, 9):
        folder = tw.simulate.ranges(n=1, rows=120, seed=k).folder()
        name = f"iasl-drone-{k}"
        tw.write(replace(folder, name=name, rig=replace(folder.rig, name=name)), tmp_path / name)
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(tmp_path))
    for cached in (sites.paths, sites.read, real.prepared):
        cached.cache_clear()
    yield
    for cached in (sites.paths, sites.read, real.prepared):
        cached.cache_clear()


def test_a_recording_is_calibrated_on_the_others_of_its_site_and_never_on_itself(drones, monkeypatch):
    seen, calibrate = [], tw.calibrate

    def noted(folders):
        seen.append([folder.name for folder in folders])
        return calibrate(folders)

    monkeypatch.setattr(tw, "calibrate", noted)
    (part,), _, on = real.prepared("iasl-drone-8", "uwb", "calibrated")
    assert (seen, part.name, on) == ([["iasl-drone-9"]], "iasl-drone-8", "1 others")


def test_a_recording_alone_of_its_installation_is_calibrated_half_by_half(drones, monkeypatch):
    monkeypatch.setattr(real, "same_installation", lambda a, b: False)
    parts, _, on = real.prepared("iasl-drone-8", "uwb", "calibrated")
    assert len(parts) == 2
    assert on == "the other half"
