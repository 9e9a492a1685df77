"""The median with missing values, for windows sorted by a network of comparators and for longer ones."""

import numpy as np
import pytest

from trackwright.trackers.parts.median import NETWORK, in_order, nan_median


@pytest.mark.parametrize("n", [1, 2, 5, 9, NETWORK, NETWORK + 3])
def test_the_median_is_that_of_the_values_that_are_seen(n):
    values = np.random.default_rng(n).normal(size=(n, 40))
    values[:, 10:][np.random.default_rng(1).uniform(size=(n, 30)) < 0.4] = np.nan
    values[:, -1] = np.nan
    with np.errstate(all="ignore"), pytest.warns(RuntimeWarning, match="All-NaN"):
        expected = np.nanmedian(values, axis=0)
    np.testing.assert_array_equal(nan_median(values), expected)


@pytest.mark.parametrize("n", range(1, NETWORK + 1))
def test_the_network_sorts_every_sequence_of_zeros_and_ones(n):
    # So it sorts all values (Knuth 1998, section 5.3.4, theorem Z).
    bits = (np.arange(2 ** min(n, 12))[None, :] >> np.arange(n)[:, None]) & 1
    bits = np.random.default_rng(0).permuted(bits, axis=0) if n > 12 else bits
    np.testing.assert_array_equal(np.stack(in_order(bits)), np.sort(bits, axis=0))
