"""What proves the product: papers, validation, verification, benchmarks."""
