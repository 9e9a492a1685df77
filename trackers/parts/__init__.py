"""Parts that several systems share: fixes, ranges, Singer's motion, starts found on the host, walls."""
