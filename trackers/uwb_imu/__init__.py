"""System C: UWB two-way ranging, trilateration, and position from ranges with and without an IMU (Kwon et al. 2021)."""
