"""The benchmarks: `python -m trackwright.experiments.lab.bench NAME [options]`; without a name, the table of them."""

from __future__ import annotations

from trackwright.experiments.lab.cases import run_case

CASES = (
    "beam",
    "particles",
    "beam:tuning",
    "growth",
    "recordings",
    "studies",
    "waiting",
    "archives",
    "cluster",
    "cluster:cluster_fit",
    "cluster_scale",
    "cluster_scale:cluster_plan",
    "gpu",
)

if __name__ == "__main__":
    run_case("bench", CASES)
