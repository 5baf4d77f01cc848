# SPDX-License-Identifier: Apache-2.0
"""A ROS domain of one's own: it is empty, and no one else takes it."""

import os
import socket

import pytest

from starpos_testing import domain
from starpos_testing.domain import DOMAINS, FIRST_PORT, LOCK_PORT, PORTS, own_domain


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    """The variables as they were, after each test."""
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"):
        monkeypatch.setenv(name, os.environ.get(name, ""))


def test_it_is_set_for_this_machine_only(monkeypatch):
    monkeypatch.setenv("ROS_STATIC_PEERS", "10.11.12.1")
    with own_domain() as number:
        assert os.environ["ROS_DOMAIN_ID"] == str(number)
        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
        assert "ROS_STATIC_PEERS" not in os.environ


def test_two_at_once_have_two():
    with own_domain() as first, own_domain() as second:
        assert first != second


def test_the_shells_is_passed_over(monkeypatch):
    with own_domain() as number:
        pass
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    with own_domain() as other:
        assert other != number


@pytest.mark.parametrize("port", [0, 10, PORTS - 1])
def test_where_somebody_listens_is_passed_over(port):
    with own_domain() as number:
        pass
    os.environ["ROS_DOMAIN_ID"] = "0"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.1", FIRST_PORT + PORTS * number + port))
        with own_domain() as other:
            assert other != number


def test_a_domain_that_domain_coordinator_has_given_is_passed_over():
    with own_domain() as number:
        pass
    os.environ["ROS_DOMAIN_ID"] = "0"
    with socket.socket() as lock:
        lock.bind(("", LOCK_PORT + number))
        with own_domain() as other:
            assert other != number


def test_a_machine_on_which_all_are_taken(monkeypatch):
    monkeypatch.setattr(domain, "_inhabited", lambda: set(DOMAINS))
    with pytest.raises(RuntimeError, match="all ROS domains from 1 to 100 are taken"), own_domain():
        pass
