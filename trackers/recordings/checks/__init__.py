"""Whether a recording is sane: time base, units, ids, gaps, outliers, geometry and dilution of precision."""
