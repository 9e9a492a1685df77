"""System C: two-way ranging, trilateration, position from ranges with and without an inertial sensor."""
