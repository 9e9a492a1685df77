"""`trackwright tune` and `sweep`; `tuning.py` does the work."""

from __future__ import annotations

from trackwright.experiments.cli.options import Recording, SweepOptions, TuneOptions


def tune(*recordings: Recording, options: TuneOptions) -> int:
    """Fit noise levels by gradient: values, intervals and a report.

    Writes tuned.toml, for `--noise` of `track`, report.html, trace.csv and a checkpoint. Other tunables than noise
    levels are fitted where --tune names them.

    Args:
        recordings: recording folders to fit to, all at once.
    """
    from trackwright.experiments.cli.console import keep_programs, prepared, running

    options.read()
    with running("tune", options.json) as run:
        run.begin("reading")
        paths = (*recordings, *options.held_out)
        # For a cluster recordings are read one by one, of which the first says what they are.
        folders = prepared(paths if options.cluster is None else paths[:1], options.used)
        run.begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        from trackwright.experiments.cli.tuning import tune_folders

        return tune_folders(folders, paths, options, run)


def sweep(*recordings: Recording, options: SweepOptions) -> int:
    """Evaluate an objective on a grid of one or two noise levels.

    Writes sweep.csv, the figure sweep.png and manifest.json.

    Args:
        recordings: recording folders, all at once.
    """
    from trackwright.experiments.cli.console import keep_programs, prepared, running

    options.read()
    _ = options.grids
    with running("sweep", options.json) as run:
        run.begin("reading")
        folders = prepared(recordings, options.used, check=False)
        run.begin("preparing")
        keep_programs()
        from trackwright.experiments.cli.tuning import sweep_folders

        sweep_folders(folders, options, run)
    return 0
