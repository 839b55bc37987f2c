import io

from qnerf.records import annotations


def test_a_note_is_written_read_and_removed(store, qnerf):
    assert qnerf("note", "aaaa", "worse", "at", "the", "edges").code == 0
    assert qnerf("note", "aaaa").out == "worse at the edges\n"
    qnerf("tag", "aaaa", "kept")
    assert qnerf("note", "aaaa", "").code == 0
    assert qnerf("note", "aaaa").out == ""
    assert qnerf("tag", "aaaa").out == "kept\n"


def test_a_note_comes_from_standard_input(store, qnerf, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("first\nsecond\n"))
    qnerf("note", "aaaa", "-")
    assert qnerf("note", "aaaa").out == "first\nsecond\n"


def test_too_long_a_note_is_refused(store, qnerf, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("x" * 20_000))
    done = qnerf("note", "aaaa", "-")
    assert (done.code, done.out) == (2, "")
    assert "expected a note of at most 10,000 characters" in done.err


def test_a_note_shows_its_lines_and_nothing_that_moves_the_cursor(store, qnerf):
    (run,) = store.glob("*-aaaaaaaaaa")
    annotations.write_note(run, "one\n\x1b[2Jtwo\u202e\rthree")
    assert qnerf("note", "aaaa").out == "one\n\\x1b[2Jtwo\\u202e\\rthree\n"
