# SPDX-License-Identifier: Apache-2.0
"""Which of its messages a player counts as frames, what it warns of, and how far it runs ahead of those who follow."""

import pytest
import rclpy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from starpos.recording.topics import FRAMES
from starpos_bringup import player as module
from starpos_bringup.bag import Topic
from starpos_bringup.player import Player
from starpos_interfaces.msg import Solution, StarArray
from starpos_testing.nodes import take_domain

IMAGES = "/camera/image_raw"
STARS, IMAGE = FRAMES[:2]
S = 10**9


def topic(name, kind, type_name):
    return Topic(name, kind, type_name, latched=False, older=None)


TOPICS = {"/stars": topic("/stars", StarArray, STARS), IMAGES: topic(IMAGES, Image, IMAGE)}


@pytest.fixture
def context():
    take_domain()
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


@pytest.fixture
def node(context):
    """A node of that context, whose publishers and subscriptions the graph shows at once."""
    node = rclpy.create_node("another", context=context)
    yield node
    node.destroy_node()


@pytest.fixture
def player_of(context):
    """Makes a player of topics, which has begun; and the list of its sentences."""
    players = []

    def player_of(*names):
        said = []
        player = Player([TOPICS[name] for name in names], 0.0, [], (context, context), said.append)
        players.append(player)
        player.wait(0.0, for_solver=False)
        player.start_round()
        return player, said

    yield player_of
    for player in players:
        player.close()


@pytest.fixture(autouse=True)
def hasty(monkeypatch):
    monkeypatch.setattr(module, "SETTLED_S", 0.0)
    monkeypatch.setattr(module, "FOUND_S", 0.1)
    monkeypatch.setattr(module, "PATIENCE_S", 0.1)
    monkeypatch.setattr(module, "AHEAD_S", 0.1)
    monkeypatch.setattr(module, "BEGUN_S", 0.0)


def play(player, name, at_s):
    player.play(TOPICS[name], at_s * S, bytes(serialize_message(TOPICS[name].kind())))


def test_what_is_published_by_another_node_too_is_named(player_of, node):
    node.create_publisher(StarArray, "/stars", 1)
    node.create_subscription(StarArray, "/stars", print, 1)
    _, said = player_of("/stars")
    assert "of the bag, another node publishes /stars" in said[-1] and "--inputs" in said[-1]


@pytest.mark.parametrize(
    ("heard", "frames"),
    [((), 2), (("/stars",), 1), ((IMAGES,), 2), (("/stars", IMAGES), 2)],
    ids=["nothing", "stars", "images", "both"],
)
def test_images_that_nobody_takes_are_no_frames_where_somebody_takes_stars(player_of, node, heard, frames):
    for name in heard:
        node.create_subscription(TOPICS[name].kind, name, print, 1)
    player, said = player_of(*TOPICS)
    for name in TOPICS:
        play(player, name, 1)
    assert (player.count, player.frames) == (2, frames)
    assert any("no node subscribes" in words for words in said) == (not heard)


def test_it_waits_for_the_answer_to_a_frame_of_long_before(player_of, node, monkeypatch):
    monkeypatch.setattr(module, "PATIENCE_S", 10.0)
    monkeypatch.setattr(module, "AHEAD_S", 1.0)
    solutions = node.create_publisher(Solution, "/solver/solution", 10)
    came = []
    node.create_subscription(StarArray, "/stars", came.append, 10)
    player, said = player_of("/stars")
    play(player, "/stars", 1)
    play(player, "/stars", 2)
    assert (player.answers, list(player._unanswered)) == (0, [S, 2 * S])
    solutions.publish(Solution(status=Solution.OK))
    play(player, "/stars", 3)
    assert (player.answers, player.fixes, list(player._unanswered)) == (1, 1, [2 * S, 3 * S])
    assert not player.lost and said == []


def test_an_answer_that_never_comes_is_named_and_no_longer_waited_for(player_of, node):
    node.create_publisher(Solution, "/solver/solution", 10)
    node.create_subscription(StarArray, "/stars", print, 10)
    player, said = player_of("/stars")
    for k in range(4):
        play(player, "/stars", 100 * k + 1)
    player.end_round()
    assert player.lost and len(said) == module.MAX_IN_VAIN and "was not answered" in said[0]


def test_the_next_image_waits_until_a_detector_has_searched_the_last(player_of, node):
    made = node.create_publisher(StarArray, "/stars", 10)
    node.create_subscription(Image, IMAGES, print, 10)
    player, said = player_of(IMAGES)
    made.publish(StarArray())
    play(player, IMAGES, 1)
    assert not player.lost and len(said) == 1
    play(player, IMAGES, 2)
    assert player.lost and "was not answered" in said[-1]
