"""The validation: `python -m trackwright.experiments.lab.validation NAME [options]`; without a name, all of it."""

from __future__ import annotations

from trackwright.experiments.lab.cases import run_case

CASES = (
    "real_recordings",
    "default_levels",
    "calibration_terms",
    "tuned_sites",
    "nis_expectation",
    "recovery",
    "recovery:motion_levels",
    "surveys",
    "surveys:real_surveys",
)

if __name__ == "__main__":
    run_case("validation", CASES)
