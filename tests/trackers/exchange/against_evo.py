"""evo's own numbers for two TUM files, or a skip where evo is not installed."""

from __future__ import annotations

import warnings

import pytest


def evo_modules():
    """evo's modules; the test is skipped without evo."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("evo", reason="evo is not installed; make test installs it")
        from evo.core import metrics, sync
        from evo.tools import file_interface
    return metrics, sync, file_interface


def evo_errors(estimate, truth, align="none", tolerance=0.01, offset=0.0, steps=("1m",)):
    """Statistics of evo by name, ape, ape_deg, rpe STEP: the estimate and truth are paths of TUM files."""
    metrics, sync, files = evo_modules()
    true, own = sync.associate_trajectories(
        files.read_tum_trajectory_file(str(truth)),
        files.read_tum_trajectory_file(str(estimate)),
        max_diff=tolerance,
        offset_2=offset,
    )
    if align in ("se3", "sim3", "scale"):
        own.align(true, correct_scale=align == "sim3", correct_only_scale=align == "scale")
    elif align == "origin":
        own.align_origin(true)
    found = {}
    relations = {"": metrics.PoseRelation.translation_part, " rad": metrics.PoseRelation.rotation_angle_rad}
    for suffix, relation in relations.items():
        ape = metrics.APE(relation)
        ape.process_data((true, own))
        found["ape" + suffix] = ape.get_all_statistics()
        for step in steps:
            unit = metrics.Unit.meters if step.endswith("m") else metrics.Unit.frames
            rpe = metrics.RPE(relation, float(step[:-1]), unit)
            rpe.process_data((true, own))
            found[f"rpe {step}{suffix}"] = rpe.get_all_statistics()
    return found, own.num_poses
