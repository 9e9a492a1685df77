"""The validation: `python -m trackwright.experiments.lab.validation NAME [options]`; without a name, all of it."""

from __future__ import annotations

from trackwright.experiments.lab.cases import run_case

CASES = (
    "real_recordings",
    "choice",
    "default_levels",
    "peer_levels",
    "calibration_terms",
    "tuned_sites",
    "envelope",
    "nis_expectation",
    "recovery",
    "recovery:motion_levels",
    "error_over_bound",
    "surveys",
    "surveys:real_surveys",
    "offsets",
    "track_loss",
    "bag_tour",
    "promises",
    "bag_tour:survey_tour",
)

if __name__ == "__main__":
    run_case("validation", CASES)
