# SPDX-License-Identifier: Apache-2.0
"""The annotated image of the running graph: the stars the solver identified are circled and counted as such."""

import numpy as np
from sensor_msgs.msg import Image

from starpos.frames.annotate import IDENTIFIED
from starpos.messages.camera import message_to_frame
from starpos.messages.stars import message_to_stars
from starpos.sky.catalogue import load_catalogue
from starpos_interfaces.msg import Solution, StarArray
from starpos_testing.graph.shots import SMALL, photograph, shoot


def test_an_image_with_the_solvers_stars_under_the_stamp_of_the_frame(graph, solver, run):
    # the first frame of a field of view waits for its triangles, longer than an annotated image waits for its solution
    graph.answer(shoot())
    run("starpos_camera", "detector")
    graph.wait_for_detector(photograph)
    stars = graph.hear(StarArray, "stars")
    # This test: the detector has no subscriber to draw for.
    assert graph.node.count_subscribers("solver/solution") == 1
    images = graph.hear(Image, "detector/image_annotated", 1)
    graph.wait(
        lambda: (
            graph.node.count_publishers("stars") == 2
            and graph.node.count_publishers("detector/image_annotated")
        )
    )

    shown, looked_at = {}, set()

    def identified(_):
        """Pictures, stars and solutions of the frames that have all three, with circles of the solver's."""
        for image in images:
            stamp = (image.header.stamp.sec, image.header.stamp.nanosec)
            seen = [s for s in stars if s.header == image.header]
            if stamp in graph.solutions and seen and stamp not in looked_at:
                looked_at.add(stamp)
                picture = message_to_frame(image).pixels
                rows, columns = np.nonzero(np.abs(picture[: SMALL[1]].astype(int) - IDENTIFIED).max(2) < 40)
                if len(rows):
                    shown.update(
                        rows=rows, columns=columns, stars=seen[0], solution=graph.solutions[stamp][-1]
                    )
        return bool(shown)

    # The first ones go before detector and solver have met once more.
    graph.photograph_until(identified, photograph)

    solution, catalogue = shown["solution"], load_catalogue()
    assert solution.status == Solution.OK
    assert len(solution.ids) == len(solution.magnitudes) == len(solution.indices) > 10
    by_name = {f"HIP {hip}": row for row, hip in enumerate(catalogue.hip.tolist()) if hip}
    known = [
        (m, by_name[name])
        for name, m in zip(solution.ids, solution.magnitudes, strict=True)
        if name in by_name
    ]
    assert len(known) > 3
    for magnitude, row in known:
        assert np.abs(catalogue.vmag(catalogue.hip == catalogue.hip[row]) - magnitude).min() < 1e-5
    of_frame = message_to_stars(shown["stars"])
    for row in solution.indices:
        if not of_frame.flags[row]:
            away = np.hypot(shown["columns"] - of_frame.x[row], shown["rows"] - of_frame.y[row])
            assert np.count_nonzero(away < 11) > 8
