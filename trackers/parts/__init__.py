"""Parts shared by several systems: fix and range sensors, Singer motion, starts, multilateration, walls."""
