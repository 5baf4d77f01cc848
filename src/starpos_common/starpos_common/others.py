# SPDX-License-Identifier: Apache-2.0
"""Other nodes that publish on this node's topics, as drivers of GNSS do on `fix`."""

from collections.abc import Iterable

from rclpy.node import Node
from rclpy.publisher import Publisher


def other_publishers(node: Node, publishers: Iterable[Publisher]) -> str:
    """Sentence that names them and the remap that ends it; '' without any."""
    own = node.get_fully_qualified_name()
    said = []
    for publisher in publishers:
        offered = node.get_publishers_info_by_topic(publisher.topic_name)
        names = {f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in offered} - {own}
        if names:
            name = publisher.topic_name.removeprefix(node.get_namespace().rstrip("/") + "/")
            said.append(
                f"{', '.join(sorted(names))} publishes on {publisher.topic_name}, too: put this node's elsewhere "
                f"(-r {name}:=stars/{name}, or outputs:=stars of the launch files)"
            )
    return "; ".join(said)
