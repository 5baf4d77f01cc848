# SPDX-License-Identifier: Apache-2.0
"""What a player warns of before it begins, and which of its messages it counts as frames."""

import pytest
import rclpy
from builtin_interfaces.msg import Time
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image, Imu
from std_msgs.msg import String

from starpos_bringup.bag import Topic
from starpos_bringup.player import FRAMES, IMU, Player
from starpos_interfaces.msg import StarArray, Taken
from starpos_testing.nodes import take_domain

IMAGES = "/camera/image_raw"
STARS, IMAGE = FRAMES[:2]


def topic(name, kind, type_name):
    return Topic(name, kind, type_name, latched=False, older="")


TOPICS = {"/stars": topic("/stars", StarArray, STARS), IMAGES: topic(IMAGES, Image, IMAGE)}
DETECTOR = Taken(node="/detector", takes=["/camera/capture", IMAGES], makes=["/stars"])
STRING = "std_msgs/msg/String"
SOLVER = Taken(node="/solver", takes=["/stars"], makes=["/solver/solution", "/fix"])


@pytest.fixture
def context():
    take_domain()
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


@pytest.fixture
def node(context):
    """A node of that context, whose publishers the graph shows at once."""
    node = rclpy.create_node("another", context=context)
    yield node
    node.destroy_node()


@pytest.fixture
def player_of(context):
    """Makes a player of topics, with nodes that take part and at once take everything; and the list of its sentences."""
    players = []

    def player_of(topics, *nodes):
        said = []
        player = Player(topics, 0.0, [], (context, context), said.append)
        players.append(player)
        for words in nodes:
            player._participants._on_taken(words)
        player._taken = lambda: None
        return player, said

    yield player_of
    for player in players:
        player.close()


def doubled(player, said):
    player._say_doubled()
    return said


def publishing(node, *names):
    for name in names:
        node.create_publisher(String if name == "/fix" else StarArray, name, 1)


def test_stars_that_are_played_and_made_of_played_images_again_are_named(player_of, node):
    publishing(node, "/stars")
    [said] = doubled(*player_of(TOPICS.values(), DETECTOR, SOLVER))
    assert said.startswith("/stars is in the bag, and is made again of what is played") and "--inputs" in said


def test_a_detector_without_images_is_no_second_publisher(player_of, node):
    publishing(node, "/stars")
    assert doubled(*player_of([TOPICS["/stars"]], DETECTOR, SOLVER)) == []


def test_another_publisher_is_named_beside_a_detector_too(player_of, node):
    publishing(node, "/stars", "/stars")
    [said] = doubled(*player_of([TOPICS["/stars"]], DETECTOR, SOLVER))
    assert said.startswith("/stars is published by another node too")


def test_fixes_that_are_played_beside_images_are_made_again_of_the_stars_in_them(player_of, node):
    publishing(node, "/fix")
    topics = [TOPICS[IMAGES], topic("/fix", String, STRING)]
    [said] = doubled(*player_of(topics, DETECTOR, SOLVER))
    assert said.startswith("/fix is in the bag, and is made again")


@pytest.mark.parametrize(
    ("nodes", "frames"),
    [((), 2), ((SOLVER,), 1), ((DETECTOR,), 2), ((DETECTOR, SOLVER), 2)],
    ids=["nobody", "solver", "detector", "both"],
)
def test_images_that_nobody_takes_are_no_frames_where_somebody_takes_stars(player_of, nodes, frames):
    player, _ = player_of(TOPICS.values(), *nodes)
    player._participants.begin()
    player._first_ns = None
    for played in TOPICS.values():
        player.play(played, 1, bytes(serialize_message(played.kind())))
    assert (player.count, player.frames) == (2, frames)


def test_a_tilt_has_its_turn_right_after_the_acceleration_that_completes_it(player_of):
    inclinometer = Taken(node="/inclinometer", takes=["/imu/data"], makes=["/tilt"])
    solver = Taken(node="/solver", takes=["/stars", "/tilt"], makes=["/solver/solution"])
    player, _ = player_of([topic("/imu/data", Imu, IMU)], inclinometer, solver)
    participants = player._participants
    participants.begin()
    player._first_ns = None
    told, tell = [], participants.tell

    def note(kind, now_ns, name, stamp, *, answer):
        told.append((name, stamp.sec, answer))
        tell(kind, now_ns, name, stamp, answer=answer)

    participants.tell = note

    def taken():
        """What the inclinometer says when the message has its turn: the second one completes a tilt."""
        made = [Time(sec=7)] if told[-1][1] == 2 else []
        now = {"replay": participants._replay, "index": participants._index}
        heard = Taken(node="/inclinometer", takes=["/imu/data"], makes=["/tilt"], stamps=made, **now)
        participants._on_taken(heard)

    player._taken = taken
    for k in (1, 2, 3):
        message = Imu()
        message.header.stamp.sec = k
        player.play(topic("/imu/data", Imu, IMU), k * 10**9, bytes(serialize_message(message)))
    assert told == [
        ("/imu/data", 1, True),
        ("/imu/data", 2, True),
        ("/tilt", 7, False),
        ("/imu/data", 3, True),
    ]
    # and the solver, which takes no accelerations, was not waited for
    assert not player.lost
