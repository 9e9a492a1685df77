"""The commands and trackers in a line each, as the help lists them: their modules take a second to import."""

from __future__ import annotations

COMMANDS = {
    "plan": "Plan an installation: maps of the bound of errors over its floor.",
    "import": "Import CSV, ROS bags, MCAP, TUM, EuRoC or logs of UWB kits.",
    "check": "Check the data: time base, gaps, outliers, ids, units, geometry.",
    "calibrate": "Fit systematic errors of stations and anchors against truth.",
    "track": "Track recordings: estimates, events, error metrics, a page with playback.",
    "evaluate": "Error metrics of estimates against truth; exit 1 by --fail-if.",
    "export": "Export tracks or truth: TUM, KITTI, CSV, ROS 2 bag, Rerun.",
    "report": "Compare runs: metrics, differences from the first, a page, figures.",
    "tune": "Fit noise levels by gradient: values, intervals and a report.",
    "sweep": "Evaluate an objective on a grid of one or two noise levels.",
    "trackers": "List the trackers and the tables they read.",
    "tunables": "List the tunables of a tracker: value, unit, bounds, meaning.",
    "simulate station": (
        "Simulate beacons at the 24 GHz work station: phases at three stations of eight antennas, with truth."
    ),
    "simulate line": "Simulate tags on the assembly line: fixes along a known path, with truth.",
    "simulate ranges": "Simulate hand-held UWB tags in a room with four anchors: ranges, with truth.",
    "simulate tool": "Simulate hand tools with a UWB tag and an IMU: ranges and IMU samples, with truth.",
    "simulate agv": "Simulate vehicles on a route round a workstation: UWB fixes that drift, with truth.",
    "study": "Run a Monte Carlo study: worlds × trackers × a grid × runs.",
    "truth": "Fit truth along a known path: the recording with a truth table.",
    "verify": "Check every gradient against an oracle; exit 1 if one fails.",
    "demo": "Simulate, check, track, evaluate and tune: a tour in out/demo.",
    "completion": "Print the completion script of a shell: bash, zsh or fish.",
}
"""The first line of each command's docstring, at most 67 characters so that the help has a line for each."""

FAMILIES = {"simulate": "Simulate a recording with truth"}
"""What commands of two words have in common, by their first word."""

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
    "uwb": "position from ranges, EKF with a drifting bias per anchor (ranges)",
    "uwb-imu": "position, velocity and attitude from ranges and an IMU, error-state EKF (ranges and imu)",
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
    "mhk-stamped": "mhk, with each estimate at the time of the middle of its median window (fixes)",
    "moving-average": "mean of the last 9 fixes, axis by axis (fixes)",
    "median": "median of the last 9 fixes, axis by axis (fixes)",
    "mhk": (
        "position from fixes: sliding median, hidden Markov model of accelerations, Kalman filter "
        "(Huang et al.) (fixes)"
    ),
}
"""What each tracker of the catalogue is, and the table it reads."""
