"""Recordings refuse what no tracker can use, and batches hold them in float32 without losing time."""

import numpy as np
import pytest

from trackwright.trackers.core.data.recording import Readings, Recording, stack


def _recording(times=(0.0, 0.1, 0.3), values=None, seen=None, name="run 3", reported=None, readings=None, **rest):
    values = np.zeros((3, 2)) if values is None else np.asarray(values, float)
    seen = np.ones(np.shape(values), bool) if seen is None else seen
    return Recording(np.asarray(times), readings or {"north": Readings(values, seen, reported)}, name=name, **rest)


SHORT = {"north": Readings(np.zeros((3, 2)), np.ones((3, 2), bool), np.zeros((2, 3)))}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"times": (0.0, 0.2, 0.1)}, r"times\[2\] = 0.1 s comes before the row above; sort the rows first"),
        ({"times": (0.0, np.nan, 0.1)}, r"times\[1\] is not finite"),
        ({"times": ()}, r"times have shape \(0,\), expected \(T,\) with at least one row"),
        ({"values": np.zeros((4, 2))}, r"'north'\] has values \(4, 2\) and seen \(4, 2\), expected \(3, channels\)"),
        ({"seen": np.ones((3, 1), bool)}, r"values \(3, 2\) and seen \(3, 1\)"),
        ({"values": [[0, 0], [0, np.nan], [0, 0]]}, "row 1, channel 1 is not finite; for a missing value store 0"),
        ({"reported": np.array([[0.1], [np.inf], [0.1]])}, "row 1, channel 0 is not finite"),
        ({"inputs": {"height": np.zeros(2)}}, "height.* 2 .*3"),
        ({"inputs": {"height": np.array([1.0, np.nan, 1.0])}}, "height.* row 1.* not finite"),
        ({"truth": {"position": (np.zeros((3, 2)), np.ones(2, bool))}}, "position"),
        ({"truth": {"position": (np.full((3, 2), np.nan), np.ones(3, bool))}}, "position.* not finite"),
        ({"readings": SHORT}, "north"),
    ],
)
def test_an_unusable_recording_is_refused_with_the_place_of_its_fault(arguments, message):
    with pytest.raises(ValueError, match=f"run 3: .*{message}|{message}") as error:
        _recording(**arguments)
    assert "\n" not in str(error.value)


def test_recordings_of_other_shapes_do_not_stack():
    with pytest.raises(ValueError, match="'b'.*1.*'a'.*2"):
        stack([_recording(name="a"), _recording(name="b", values=np.zeros((3, 1)))])


def test_rows_beyond_the_end_are_not_valid_and_hold_zeros():
    short = Recording(np.array([5.0]), {"north": Readings(np.full((1, 2), 7.0), np.ones((1, 2), bool))})
    batch = stack([_recording(values=np.ones((3, 2))), short], rows=4)
    np.testing.assert_array_equal(batch.valid, [[1, 1], [1, 0], [1, 0], [0, 0]])
    np.testing.assert_array_equal(batch.readings["north"].values[:, 0], [[1, 7], [1, 0], [1, 0], [0, 0]])
    assert not batch.readings["north"].seen[1:, :, 1].any()


def test_time_steps_keep_their_digits_in_single_precision_far_from_zero():
    # A microsecond's step at a Unix time: the times themselves would be 128 s apart in float32.
    times = 1.7e9 + np.cumsum([0.0, 1e-3, 2e-3])
    batch = stack([_recording(times=times)], dtype=np.float32)
    assert batch.dt.dtype == np.float32
    np.testing.assert_allclose(batch.dt[:, 0], np.diff(times, prepend=times[:1]), rtol=1e-7)


def test_the_arrays_of_a_recording_are_read_only_views():
    times, values, seen, reported = np.arange(3.0), np.zeros((3, 2)), np.ones((3, 2), bool), np.ones((3, 1))
    heights, true, known = np.ones(3), np.zeros((3, 3)), np.ones(3, bool)
    readings = {"north": Readings(values, seen, reported)}
    made = Recording(times, readings, {"height": heights}, {"position": (true, known)})
    north = made.readings["north"]
    arrays = [made.times, north.values, north.seen, north.reported, made.inputs["height"], *made.truth["position"]]
    for array, given in zip(arrays, (times, values, seen, reported, heights, true, known), strict=True):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
        assert np.shares_memory(array, given)
        # The caller's array stays writable, and an array made from the view is a new one.
        given[0] = 0
        array.copy()[0] = 1
