"""The assembly-line thesis: the UWB tag on a known path, its printed tables and figures."""
