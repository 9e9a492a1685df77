"""The report of a tuning run: complete, in one file, true to its numbers, and outspoken where a result is doubtful."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from tests.experiments.pages.reports.tuning_report_data import report_data
from trackwright.experiments.pages.reports.before_after import NO_PLANS, Compared, Verdict
from trackwright.experiments.pages.reports.pages import write_page
from trackwright.experiments.pages.reports.tuning import (
    OptimiserTrace,
    TunedParameter,
    advice_on,
    agreement,
    tuning_page,
)
from trackwright.experiments.text.tables import Section
from trackwright.experiments.text.wording import number
from trackwright.trackers.evaluation.comparison import Difference

EMPTY = {"meta", "img", "br", "link"}


class Page(HTMLParser):
    """Elements that are open, everything that refers to something, tables' cells, and the text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.addresses, self.cells, self.text, self.sections = [], [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.addresses += [v for k, v in named.items() if k in ("src", "href", "srcset", "data", "action")]
        if tag == "section":
            self.sections.append(named["id"])
        if tag in ("td", "th"):
            self.cells.append("")
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)
        if self.open and {"td", "th"} & set(self.open):
            self.cells[-1] += data


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_page(tmp_path_factory.mktemp("report") / "report.html", tuning_page(report_data())).read_text("utf-8")


@pytest.fixture(scope="module")
def parsed(written):
    return Page(written)


def test_every_element_is_closed_and_every_section_is_there(parsed):
    assert parsed.open == []
    assert parsed.sections == [
        "settings", "tuned-parameters", "optimisation", "consistency-of-the-filter",
        "errors-against-truth", "commands",
    ]  # fmt: skip


def test_the_page_needs_nothing_from_anywhere_else(written, parsed):
    assert parsed.addresses == []
    assert not re.search(r"<script[^>]+src|<link|<iframe", written)
    assert not re.search(r"url\(|@import", re.sub(r"<script.*?</script>", "", written, flags=re.DOTALL))


def test_the_tables_hold_the_numbers_they_were_given(parsed):
    text = " ".join(parsed.cells)
    for n in report_data().parameters:
        assert n.name in text
        for value in (n.before, n.after, n.low, n.high):
            assert number(value) in text


def test_commands_and_recordings_are_named(parsed):
    text = "".join(parsed.text)
    for word in (
        *report_data().commands,
        *report_data().training,
        *report_data().held_out,
        "4\u202f321",
    ):
        assert word in text


def test_what_users_type_is_text_and_never_markup():
    named = Page(tuning_page(report_data(commands=("tune <script>alert(1)</script> 'a&b'",), training=("<b>",))))
    assert "script" not in named.open
    assert "tune <script>alert(1)</script> 'a&b'" in "".join(named.text)


def _compared(*change, worse=()):
    """A table with this change of the log density, and the names of recordings that got worse."""
    difference = Difference(*change, 0.0, 30)
    return Compared("held-out recordings", Section("Recordings"), Verdict(difference, dict.fromkeys(worse, difference)))


def test_the_page_opens_with_the_verdict_and_nothing_warns_of_a_better_one():
    kept = tuple(n for n in report_data().parameters if n.determined)
    word, summary, warnings = advice_on(report_data(parameters=kept, compared=_compared(-2.0, 1.0, 2.5, 3.5)))
    assert (word, warnings) == ("Better.", [])
    by = "Mean log density of the true position, held-out recordings: -2.00 → 1.00 nats, +3.00 (95 % interval +2.50 to +3.50)."
    assert summary.startswith(by)
    assert "0.4812 to 0.1327" in summary
    assert "determine 2 of 2 parameters" in summary


@pytest.mark.parametrize(
    ("change", "word"), [((1.0, 0.5, -0.9, -0.1), "Worse."), ((1.0, 0.9, -0.4, 0.2), "Not told apart.")]
)
def test_other_verdicts_are_no_recommendation_and_name_the_recordings_that_got_worse(change, word):
    found, _, warnings = advice_on(report_data(compared=_compared(*change, worse=("line-c",))))
    assert found == word
    assert warnings[0].startswith(f"line-c got worse, 1.00 → {change[1]:.2f} nats") == (word == "Worse.")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ("do not determine start.sigma_start", "freeze or tie")),
        ({"issues": ("a and b are not determined one by one",)}, ("a and b are not", "freeze or tie")),
    ],
)
def test_what_the_recordings_do_not_determine_is_said_in_words(changes, words):
    _, _, warnings = advice_on(report_data(**changes))
    assert any(all(word in warning for word in words) for warning in warnings)


def test_a_run_without_truth_held_out_recordings_starts_or_intervals_has_a_page_too():
    numbers = (TunedParameter("motion.sigma_a", "1", 0.05, 0.1),)
    bare = report_data(held_out=(), parameters=numbers, plans=NO_PLANS, innovations=None, traces=())
    shown = Page(tuning_page(bare))
    assert shown.open == []
    assert shown.sections == ["settings", "tuned-parameters", "commands"]


def test_how_many_starts_end_at_one_point_is_said_and_whether_another_is_lower():
    def start(end, objective):
        return OptimiserTrace(np.array([9.0, objective]), np.array([[5.0, 5.0], end]))

    near, far, lower = start([1.05, 2.0], 1.0), start([1.0, 2.5], 1.2), start([3.0, 2.0], 0.5)
    at = "end at the selected point (values within a tenth)"
    assert agreement([start([1.0, 2.0], 1.0), near]) == f"2 of 2 starts {at}."
    assert agreement([start([1.0, 2.0], 1.0), far, lower]) == f"1 of 3 starts {at}, 1 elsewhere with a lower objective."
    assert agreement([near, near, far]) == f"2 of 3 starts {at}, none elsewhere with a lower objective."
