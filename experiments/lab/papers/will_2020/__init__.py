"""Will et al. 2020: the 24 GHz beacon, its printed tables and figures."""
