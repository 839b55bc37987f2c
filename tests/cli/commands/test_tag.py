"""Tags, and the file that they are in."""

import multiprocessing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf.records import StoreError, annotations


def test_tags_are_added_removed_and_listed(store, qnerf):
    assert qnerf("tag", "aaaa", "good", "base,old").out == "base\ngood\nold\n"
    assert qnerf("tag", "aaaa", "new", "--remove", "old", "--remove", "base").out == "good\nnew\n"
    assert qnerf("tag", "aaaa").out == "good\nnew\n"
    assert qnerf("tag", "bbbb").out == ""


def test_tag_refuses_what_is_no_tag(store, qnerf):
    for tag in ("two words", "k=v", "\x1b[31m", "a\u202eb", "x" * 65, "line\nline"):
        done = qnerf("tag", "aaaa", tag)
        assert (done.code, done.err.count("\n"), done.err[:-1].isprintable()) == (2, 1, True)
        assert "expected a tag of 1 to 64 visible characters" in done.err
    assert qnerf("tag", "aaaa").out == ""
    qnerf("tag", "aaaa", "good")
    done = qnerf("tag", "aaaa", "--remove", "bad")
    assert (done.code, done.err) == (2, "error: poster-qcolor-s0-aaaaaaaaaa has no tag bad; it has good\n")


def test_a_run_takes_so_many_tags_and_no_more(make):
    run = make("a")
    annotations.change_tags(run, [f"t{i}" for i in range(annotations.TAGS)])
    with pytest.raises(ValueError, match="at most 100 tags a run, got 101"):
        annotations.change_tags(run, ["more"])


def _tag(run, number):
    for i in range(10):
        annotations.change_tags(run, [f"p{number}-{i}"])


def test_processes_that_tag_at_once_lose_nothing(make):
    run = make("a")
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=_tag, args=(run, number)) for number in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    assert set(annotations.read(run).tags) == {f"p{number}-{i}" for number in range(4) for i in range(10)}


@pytest.mark.parametrize("content", ["", "[]", '{"tags": 3}', '{"tags": [1]}', '{"note": null}'])
def test_a_damaged_file_is_told_and_left_alone(make, content):
    run = make("a")
    (run / annotations.FILE).write_text(content)
    for touch in (lambda: annotations.read(run), lambda: annotations.change_tags(run, ["one"])):
        with pytest.raises(StoreError, match=r"annotations\.json"):
            touch()
    assert (run / annotations.FILE).read_text() == content


@given(tag=st.text(min_size=1, max_size=64))
def test_a_tag_that_is_accepted_is_one_visible_word(tag):
    fits = True
    try:
        annotations.check_tag(tag)
    except ValueError:
        fits = False
    assert fits == (tag.isprintable() and tag.split() == [tag] and "," not in tag and "=" not in tag)


def test_a_note_is_written_shown_and_removed_beside_the_tags(store, qnerf):
    qnerf("tag", "aaaa", "kept", "--note", "one\n\x1b[2Jtwo\u202e\rthree")
    shown = qnerf("show", "aaaa").out
    assert "note       one\n\\x1b[2Jtwo\\u202e\\rthree\n" in shown
    assert qnerf("tag", "aaaa", "--note", "").out == "kept\n"
    assert "note " not in qnerf("show", "aaaa").out
    assert "expected a note of at most 10,000 characters" in qnerf("tag", "aaaa", "--note", "x" * 20_000).err
