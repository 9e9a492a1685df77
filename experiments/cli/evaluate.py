"""`trackwright evaluate`; `evaluating.py` and, for archives, `archive.py` do the work."""

from __future__ import annotations

from pathlib import Path

from trackwright.experiments.cli.options import EvaluateOptions
from trackwright.trackers.core.errors import UnusableInput

DEFAULTS = EvaluateOptions()


def evaluate_tracks(folder: Path, /, *, options: EvaluateOptions = DEFAULTS) -> int:
    """Error metrics of estimates against truth; exit 1 by --fail-if.

    By track, by recording and overall; writes evaluation.json. Of a file of estimates (TUM, KITTI, EuRoC, or a table
    with t_s, x_m, y_m), and with --align and what follows it, also absolute and relative pose errors as in evo.

    Args:
        folder: the output folder of `track`, of one recording, several or an archive, or a file of estimates, of one
            tag, which --tag names.
    """
    poses, truth, worksteps = options.poses, options.truth, options.worksteps
    if options.tolerance is not None and worksteps is None:
        raise UnusableInput(
            f"--tolerance {options.tolerance:g}: applies to fastening points; expected --worksteps POINTS too"
        )
    if not folder.exists():
        raise UnusableInput(
            f"{folder}: no such file; expected a folder with tracks.parquet that `track` wrote, or a file of estimates"
        )
    from trackwright.experiments.cli.archives.folders import RECORDINGS, is_archive
    from trackwright.experiments.cli.evaluating import evaluate_folder, evaluate_poses, sources
    from trackwright.trackers.recordings.tracks_table import TRACKS

    if is_archive(folder):
        if poses.given or truth or worksteps is not None:
            raise UnusableInput(
                f"{folder}: is an archive; expected no --truth, --worksteps and trajectory options; "
                f"evaluate one of {folder / RECORDINGS}/*/*"
            )
        # jax takes a second to import, which the help and a refused folder need not wait for.
        from trackwright.experiments.cli.archive import evaluate_archive

        return evaluate_archive(folder, options)
    if (folder / RECORDINGS).is_dir() and not (folder / TRACKS).exists():
        raise UnusableInput(f"{folder}: an archive that was not tracked to its end; run the same `track` again")
    if folder.is_file() or poses.given or not all(path.is_dir() for path in truth):
        if worksteps is not None or options.cluster is not None:
            raise UnusableInput(
                "--worksteps and --cluster: apply to a folder of `track`, without trajectory options and files"
            )
        known = truth if truth or folder.is_file() else sources(folder)
        return evaluate_poses(folder, known, options)
    return evaluate_folder(folder, options)
