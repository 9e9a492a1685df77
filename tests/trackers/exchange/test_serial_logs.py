"""Logs of DWM1001 and TREK1000 kits, with the lines that the makers' manuals print."""

from __future__ import annotations

import pytest

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.formats import format_of
from trackwright.trackers.exchange.imported import read_source
from trackwright.trackers.exchange.mapping import Asked, TableMapping

# Output of the DWM1001's shell, commands les, lec and lep, as public code quotes it.
LES = (
    "1151[5.00,8.00,2.25]=6.48 0CA8[0.00,8.00,2.25]=6.51 111C[5.00,0.00,2.25]=3.18 1150[0.00,0.00,2.25]=3.16 "
    "le_us=2576 est[2.57,1.98,1.68,100]"
)
LEC = (
    "DIST,4,AN0,1151,5.00,8.00,2.25,6.44,AN1,0CA8,0.00,8.00,2.25,6.50,AN2,111C,5.00,0.00,2.25,3.24,"
    "AN3,1150,0.00,0.00,2.25,3.19,POS,2.55,2.01,1.71,98"
)
LEP = "POS,2.57,2.00,1.67,97"
# TREK1000 user manual, 8.1.1.
TREK = (
    "mr 0f 000005a4 000004c8 00000436 000003f9 0958 c0 40424042 a0:0\n"
    "ma 07 00000000 0000085c 00000659 000006b7 095b 26 00024bed a0:0\n"
    "mc 0f 00000663 000005a3 00000512 000004cb 095f c1 00024c24 a0:0\n"
)


def _log(tmp_path, text, kind="dwm1001", tag="T", **options):
    path = tmp_path / "log.txt"
    path.write_text(text)
    return read_source(path, kind, Asked([TableMapping("ranges", tag=tag)], **options))


def test_the_lines_of_the_dwm1001_guide_are_ranges_fixes_and_anchors(tmp_path):
    log = _log(tmp_path, f"dwm> les\n0.1 {LES}\n0.2 {LEC}\n0.3 {LEP}\n")
    ranges, fixes = (log.tables[name].rows() for name in ("ranges", "fixes"))
    assert (len(ranges), ranges[0], ranges[7]) == (8, (0.1, "T", "1151", 6.48), (0.2, "T", "1150", 3.19))
    assert fixes == [(0.1, "T", 2.57, 1.98, 1.68), (0.2, "T", 2.55, 2.01, 1.71), (0.3, "T", 2.57, 2.0, 1.67)]
    places = {"1151": (5.0, 8.0), "0CA8": (0.0, 8.0), "111C": (5.0, 0.0), "1150": (0.0, 0.0)}
    assert log.anchors == {anchor: (*place, 2.25) for anchor, place in places.items()}


def test_the_lines_of_the_trek1000_manual_are_corrected_ranges_in_metres(tmp_path):
    log = _log(tmp_path, TREK, "trek1000", None)
    rows = enumerate((1.635, 1.443, 1.298, 1.227))
    assert log.tables["ranges"].rows() == [(0x24C24 / 1000, "0", f"{k}", distance) for k, distance in rows]
    assert log.notices == ["2 lines of raw (mr) and anchor (ma) ranges left out; mc lines are used"]


@pytest.mark.parametrize(
    ("prefixes", "times"),
    [
        (("0.5 ", "0.75,"), [0.5, 0.75]),
        (("[1718000000.25] ", "1718000001.5: "), [1718000000.25, 1718000001.5]),
        (("2026-05-01T00:00:00.250Z ", "2026-05-01 00:00:00.5 "), [1777593600.25, 1777593600.5]),
        (("[23:59:59.5] ", "[00:00:00.5] "), [86399.5, 86400.5]),
        (("12:00:00.250 -> ", "12:00:00.500 -> dwm> "), [43200.25, 43200.5]),
    ],
)
def test_the_time_before_a_line_is_its_time(tmp_path, prefixes, times):
    log = _log(tmp_path, "".join(f"{prefix}{LEP}\n" for prefix in prefixes))
    assert log.tables["fixes"]["t_s"].to_list() == pytest.approx(times, abs=1e-6)


def test_a_log_without_times_needs_an_interval(tmp_path):
    with pytest.raises(UnusableInput, match="line 1: no time .* --interval"):
        _log(tmp_path, f"{LEP}\n{LEP}\n")
    log = _log(tmp_path, f"{LEP}\n{LEP}\n", interval=0.1)
    assert log.tables["fixes"]["t_s"].to_list() == [0.0, 0.1]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("0.2 DIST,4,AN0,1151,5.00,8.00", "line 2: 'DIST,4"),
        ("0.2 1151[5.00,8.00,2.25]=6.48 0CA8[0.00", "line 2"),
        (f"noon {LEP}", "line 2: 'noon'"),
    ],
)
def test_a_line_that_is_not_understood_is_refused_or_counted(tmp_path, line, words):
    text = f"0.1 {LEC}\n{line}\n0.3 {LEP}\n"
    with pytest.raises(UnusableInput, match="--skip-bad-lines") as refused:
        _log(tmp_path, text)
    assert words in str(refused.value)
    log = _log(tmp_path, text, skip=True)
    assert log.notices == ["1 line could not be read, left out: 2"]
    assert len(log.tables["fixes"]) == 2


# DWM3001CDK SDK Developer Guide, results of INITF.
FIRA = (
    '{"Block":0, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":9,"LPDoA_deg":113.38,"LAoA_deg":46.35,"LFoM":0,'
    '"RAoA_deg":-59.33,"CFO_ppm":-0.58}]}\n'
    '{"Block":2, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":150,"LPDoA_deg":0.00,"LAoA_deg":0.00,"LFoM":0,'
    '"RAoA_deg":0.00,"CFO_ppm":-0.58},{"Addr":"0x0002","Status":"Err"}]}\n'
)


def test_the_results_of_a_kit_with_fira_are_distances_and_angles_of_an_anchor_or_of_the_tag(tmp_path):
    (tmp_path / "A1.log").write_text("minicom\nINITF\nok\n" + FIRA)
    assert format_of(tmp_path / "A1.log") == "fira"
    log = read_source(tmp_path / "A1.log", "fira", Asked([TableMapping("ranges")], interval=0.2))
    assert log.tables["ranges"].rows() == [(0.0, "0001", "A1", 0.09), (0.4, "0001", "A1", 1.5)]
    (bearing,) = log.tables["bearings"].rows(named=True)
    assert bearing == {
        "t_s": 0.0, "tag": "0001", "station": "A1", "azimuth_rad": pytest.approx(0.80896, abs=1e-5),
        "elevation_rad": None,
    }  # fmt: skip
    assert log.notices == ["1 exchange without a result left out"]
    log = _log(tmp_path, "12:00:00.5 " + FIRA.replace("\n{", "\n12:00:00.7 {"), "fira", "T")
    assert log.tables["ranges"].rows()[1] == (43200.7, "T", "0001", 1.5)
    assert log.tables["bearings"]["station"].to_list() == ["0001"]
    assert log.tables["bearings"]["azimuth_rad"][0] == pytest.approx(-1.03550, abs=1e-5)
