# SPDX-License-Identifier: Apache-2.0
"""Two inclinometers on one topic are seen, however they send; one that alone has sent for a second is trusted again."""

import pytest

from starpos.session.tilts import TiltPublishers


def heard(messages) -> TiltPublishers:
    """After messages (frame, number, seconds)."""
    publishers = TiltPublishers()
    for message in messages:
        publishers.note(*message)
    return publishers


def test_one_publisher_is_alone_also_where_messages_are_lost():
    numbers = [1, 2, 3, 7, 8, 50]
    assert not heard(("s", n, 0.1 * k) for k, n in enumerate(numbers)).several
    assert not heard(("s", n, 60.0 * k) for k, n in enumerate(numbers)).several


@pytest.mark.parametrize("frames", [("s", "other"), ("s", "s")])
@pytest.mark.parametrize("begin", [(1, 1), (1, 500), (500, 1), (7, 8)])
@pytest.mark.parametrize("often", [1, 10])
def test_two_publishers_are_seen_within_two_messages_of_each(frames, begin, often):
    publishers, told = TiltPublishers(), []
    numbers = list(begin)
    for k in range(3):
        for which, count in ((0, 1), (1, often)):
            for _ in range(count):
                publishers.note(frames[which], numbers[which], 0.1 * k)
                numbers[which] += 1
                told.append(bool(publishers.several))
    assert all(told[2 * (1 + often) :])
    assert "stop all but one" in publishers.several


@pytest.mark.parametrize("frames", [("s", "other"), ("s", "s")])
def test_two_publishers_that_send_seldom_are_seen(frames):
    """Each is silent for longer than a second before the other sends."""
    messages = [(frames[k % 2], 1 + k // 2, 1.3 * k) for k in range(20)]
    assert all(heard(messages[:k]).several for k in range(5, 20))
    alone = [(frames[0], 11 + k, 26 + 2.6 * k) for k in range(5)]
    assert not heard([*messages, *alone]).several


@pytest.mark.parametrize("silent_s", [0.5, 1.5, 20.0])
@pytest.mark.parametrize(("own", "other"), [(501, 1), (51, 1000), (5, 900)])
@pytest.mark.parametrize("first", ["own", "other"])
def test_readings_of_another_are_seen_in_the_first_exposure_that_mixes_them(silent_s, own, other, first):
    """The other's come all at once, before the own ones or after them, when the own ones were silent for a while."""
    before = [("s", own - 5 + k, 0.1 * k) for k in range(5)]
    now_s = 0.4 + silent_s
    mine, foreign = ([("s", begin + k, now_s) for k in range(5)] for begin in (own, other))
    assert heard([*before, *(mine + foreign if first == "own" else foreign + mine)]).several


def test_a_frame_that_changes_is_another_inclinometer():
    assert "'a' and 'b'" in heard([("a", 1, 0.0), ("b", 2, 0.1)]).several


def test_the_one_that_goes_on_is_trusted_after_a_second_alone():
    both = [(f, n, 0.1 * n) for n in range(10) for f in ("a", "b")]
    after = [("a", n, 0.1 * n) for n in range(10, 19)]
    assert heard([*both, *after]).several
    assert not heard([*both, *after, ("a", 19, 1.95)]).several


def test_a_publisher_that_was_restarted_is_trusted_after_a_second():
    before = [("a", n, 0.1 * n) for n in range(100)]
    assert heard([*before, ("a", 1, 10.0)]).several
    assert not heard([*before, *(("a", 1 + n, 10.0 + 0.1 * n) for n in range(12))]).several
    assert not heard([*before, ("a", 1, 12.0)]).several
    # its numbers pass those that it had before
    again = [("a", 1 + n, 10.0 + 0.05 * n) for n in range(150)]
    assert not any(heard([*before, *again[:n]]).several for n in range(60, 150))


def test_a_middleware_that_numbers_nothing_tells_frames_apart():
    assert not heard([("a", None, 0.0), ("a", None, 0.1)]).several
    assert heard([("a", None, 0.0), ("b", None, 0.1)]).several
