"""Errors as a user reads them."""

from hypothesis import given
from hypothesis import strategies as st

from objslam.core.diagnostics import Ledger
from objslam.errors import SolveError, one_line


@given(st.text(), st.none() | st.text(), st.none() | st.text())
def test_every_error_is_one_line_that_can_be_written(message, where, hint):
    error = SolveError(message, where=where, hint=hint)
    for text in (str(error), error.message, error.where or "", error.hint or ""):
        assert len(text.splitlines()) <= 1
        text.encode()


@given(st.text(), st.none() | st.text())
def test_every_line_of_a_ledger_is_one_that_can_be_written(text, where):
    ledger = Ledger()
    ledger.drop(text, where=where)
    ledger.warn(text)
    for line in ledger.lines():
        assert len(line.splitlines()) <= 1
        line.encode()


def test_the_words_stay():
    assert one_line("a  file with  spaces: 3 µm") == "a  file with  spaces: 3 µm"
    assert one_line("\n\nfirst,\r\n  then\n\nlast\n") == "first, then last"
    assert one_line("half \ud800") == "half \\ud800"
    assert one_line(KeyError()) == "KeyError"
    assert one_line("") == ""
