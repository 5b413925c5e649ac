"""The progress bar of loops over many things."""

import io

import pytest

from derender.cli import options as bar


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def shown(monkeypatch):
    def run(stream, patience, show=True):
        monkeypatch.setattr(bar.sys, "stderr", stream)
        monkeypatch.setattr(bar, "PATIENCE", patience)
        assert list(bar.Talk(0 if show else -1).counted("abc", 3, "reading letter")) == ["a", "b", "c"]
        return stream.getvalue()

    return run


def test_what_takes_long_is_counted_and_its_line_cleared(shown):
    text = shown(Terminal(), -1.0)
    assert "reading letter 2 of 3" in text and text.endswith("\r\x1b[K")


@pytest.mark.parametrize(
    "stream, patience, show",
    [(io.StringIO(), -1.0, True), (Terminal(), 60.0, True), (Terminal(), -1.0, False)],
    ids=["no terminal", "done at once", "asked for silence"],
)
def test_else_nothing_is_said(shown, stream, patience, show):
    assert shown(stream, patience, show) == ""
