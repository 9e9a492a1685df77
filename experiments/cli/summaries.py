"""The commands and trackers in a line each, as the help lists them: their modules take a second to import."""

from __future__ import annotations

COMMANDS = {
    "simulate": "Simulate beacons at the 24 GHz work station: phases at three stations of eight antennas, with truth.",
    "simulate-line": "Simulate tags on the assembly line: fixes along a known path, with truth.",
    "simulate-ranges": "Simulate hand-held UWB tags in a room with four anchors: ranges, with truth.",
    "simulate-imu": "Simulate hand tools with a UWB tag and an IMU: ranges and IMU samples, with truth.",
    "simulate-agv": "Simulate vehicles on a route round a workstation: UWB fixes that drift, with truth.",
    "check": "Check the data quality of recordings: time base, gaps, outliers, ids, units, truth, geometry.",
    "calibrate": (
        "Fit systematic errors of stations and anchors to recordings with truth: writes calibration.toml and a page."
    ),
    "track": "Track recordings: writes tracks.parquet, events.parquet, figures and manifest.json.",
    "evaluate": (
        "Error metrics of estimates against truth, by track, by recording and overall. Exit code 1 with --fail-if."
    ),
    "tune": (
        "Fit noise levels (and other tunables) to recordings by gradient: writes tuned.toml, report.html, trace.csv."
    ),
    "sweep": (
        "Evaluate an objective on a grid of one or two noise levels: writes sweep.csv, sweep.png and manifest.json."
    ),
    "study": "How accurate would this be? Run a study (worlds × trackers × grid × runs) and write report.html.",
    "report": "Compare two runs: print their metrics side by side, and write them as a page.",
    "truth": "Fit ground truth along a known path by least squares: writes the recording with a truth table.",
    "verify": (
        "Check every gradient against an oracle that shares no code with it: prints a table, exits 1 if a check fails."
    ),
}
"""The first line of each command's docstring."""

TRACKERS = {
    "direct": "position from the phases of all stations in one EKF, spherical waves (phases)",
    "cascade": "3-D position from phases, a beam tracker per station, then bearings-only fusion (Will et al.) (phases)",
    "beam": "azimuth and elevation per station from phases, EKF (Will et al.) (phases)",
    "das": "azimuth and elevation per station from phases, delay-and-sum on each row without a filter (phases)",
    "bearings": "position from azimuths and elevations of any number of stations, EKF (bearings)",
    "line-grid": (
        "position on a known path from ranges or fixes, grid filter of arclength and speed (ranges or "
        "fixes, and [path])"
    ),
    "line-pf": (
        "position on a known path from ranges or fixes, particle filter with 1,000 particles (thesis) "
        "(ranges or fixes, and [path])"
    ),
    "uwb-imu": "position, velocity and attitude from ranges and an IMU, error-state EKF (ranges and imu)",
    "uwb": "position from ranges, EKF with a drifting bias per anchor (ranges)",
    "multilateration": "position from the latest ranges, robust least squares without a filter (ranges)",
    "trilateration": (
        "planar position from three ranges, intersection of circles (Kwon et al.) without compensation (14) (ranges)"
    ),
    "trilateration-compensated": (
        "planar position from three ranges, intersection of circles with compensation (14) (Kwon et al.) (ranges)"
    ),
    "floor-pf": "position from fixes on a floor with walls, particle filter with 1,000 particles (fixes, and [floor])",
    "fix-kf": "position from fixes, Kalman filter, constant velocity in x and y (fixes)",
    "fix-singer": "position from fixes, Kalman filter, Singer's acceleration model (fixes)",
    "imm": "position from fixes, IMM filter of three constant-velocity models (fixes)",
    "fix-mirror": "position from fixes whose z may be mirrored in the anchors' plane, IMM filter of both sides (fixes)",
    "moving-average": "mean of the last 9 fixes, axis by axis (fixes)",
    "median": "median of the last 9 fixes, axis by axis (fixes)",
    "mhk": (
        "position from fixes: sliding median, hidden Markov model of accelerations, Kalman filter "
        "(Huang et al.) (fixes)"
    ),
    "mhk-stamped": "mhk, with each estimate at the time of the middle of its median window (fixes)",
}
"""What each tracker of the catalogue is, and the table it reads."""
