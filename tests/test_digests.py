"""What is named when numbers of two commits are compared."""

import numpy as np

from tests.digests import differences


def test_every_array_that_moved_by_a_bit_is_named_with_its_size(tmp_path):
    before = {"same": np.array([1.0, np.nan]), "moved": np.array([1.0, 2.0]), "gone": np.zeros(1), "cut": np.zeros(3)}
    after = before | {"moved": np.array([1.0, np.nextafter(2.0, 3.0)]), "new": np.zeros(1), "cut": np.zeros(2)}
    after |= {"words": np.array(["ok", "lost"])}
    before |= {"words": np.array(["ok", "ok"])}
    del after["gone"]
    paths = [tmp_path / side / "case, x.npz" for side in ("before", "after")]
    for path, arrays in zip(paths, (before, after), strict=True):
        path.parent.mkdir()
        np.savez(path, **arrays)
    assert list(differences(*paths)) == [
        "case, x: cut: shape (3,) became (2,)",
        "case, x: gone: is gone",
        "case, x: moved: 1 of 2 differ, by at most 2.2e-16 relative",
        "case, x: new: is new",
        "case, x: words: 1 of 2 differ",
    ]
