"""What proves the product: papers, questions, validation, verification, benchmarks."""
