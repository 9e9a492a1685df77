"""Kwon et al. 2021: UWB and IMU in a hand tool, its printed tables and figures."""
