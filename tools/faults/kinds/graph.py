# SPDX-License-Identifier: Apache-2.0
"""Publishers that are too many, intrinsics, services, parameters."""

from copy import deepcopy

from accelerated import World
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import Trigger

from kinds.registry import HOSTILE, INF, NAN, kind
from starpos_interfaces.srv import Calibrate, SaveCalibration, SelfCalibrate, Solve


@kind(0.7)
def second_publisher(w: World):
    """Another node publishes on stars (the same frames again) or camera_info."""
    node, shot = w.graph.node, w.shot()
    topic = w.rng.choice(["stars", "camera/camera_info"])
    kind_of = {"stars": type(shot.stars), "camera/camera_info": CameraInfo}[topic]
    other = node.create_publisher(kind_of, topic, QoSProfile(depth=100))
    w.graph.comes(lambda: other.get_subscription_count() > 0, 1.0)
    for _ in range(3):
        shot = w.shot()
        w.send(shot)
        if topic == "stars":
            other.publish(shot.stars)
        else:
            foreign = deepcopy(shot.info)
            foreign.k[0] = foreign.k[4] = foreign.k[0] * w.rng.choice([0.9, 1.02, 1.1])
            other.publish(foreign)
        w.spin(0.03)
    node.destroy_publisher(other)


@kind(2)
def camera_info_wrong(w: World):
    """Another size, focal length or model, NaN, zeros, a crop: for a frame."""
    shot = w.shot()
    info = shot.info
    changes = (
        lambda: setattr(info, "width", 5616),
        lambda: setattr(info, "height", 0),
        lambda: setattr(info, "k", [0.0] * 9),
        lambda: setattr(info, "k", [float(v) for v in w.rng.choice(HOSTILE, 9)]),
        lambda: setattr(info, "d", [NAN] * 5),
        lambda: setattr(info, "d", [float(v) for v in w.rng.choice(HOSTILE, 5)]),
        lambda: setattr(info, "d", [0.0] * 8),
        lambda: setattr(info, "distortion_model", "equidistant"),
        lambda: setattr(info, "binning_x", 2),
        lambda: setattr(info.roi, "x_offset", 10),
        lambda: info.k.__setitem__(0, -info.k[0]),
        lambda: (info.k.__setitem__(0, info.k[0] * 1.042), info.k.__setitem__(4, info.k[4] * 1.042)),
    )
    changes[w.rng.integers(len(changes))]()
    w.send(shot)


@kind(1)
def services_called(w: World):
    """Any service with any request, also hostile ones."""
    graph, rng = w.graph, w.rng
    call = rng.integers(7)
    if call == 0:
        graph.call(Solve, "solver/solve", Solve.Request())
    elif call == 1:
        graph.call(Trigger, "solver/reset", Trigger.Request())
    elif call == 2:
        request = Calibrate.Request(latitude=float(rng.choice([NAN, INF, 91.0])), longitude=1e9)
        graph.call(Calibrate, "solver/calibrate", request)
    elif call == 3:
        request = Calibrate.Request(frames=4294967295)
        graph.call(Calibrate, "solver/calibrate", request)
    # A wrong place: the frames refuse it, or a reset follows.
    elif call == 4:
        graph.call(SelfCalibrate, "solver/self_calibrate", SelfCalibrate.Request())
    else:
        path = str(rng.choice(["/dev/null", "relative.yaml", "/proc/1/x", "/" + "x" * 300]))
        graph.call(SaveCalibration, "solver/save_calibration", SaveCalibration.Request(path=path))


@kind(0.3)
def calibration_at_the_place(w: World):
    """solver/reset, five frames, solver/calibrate with the true place; then calibration_url again."""
    graph, site = w.graph, w.scene.site
    graph.call(Trigger, "solver/reset", Trigger.Request())
    for _ in range(5):
        w.good()
    request = Calibrate.Request(latitude=site.latitude_deg, longitude=site.longitude_deg)
    graph.call(Calibrate, "solver/calibrate", request)
    for _ in range(3):
        w.good()
    w.restore_parameters()


WILD = {
    "min_stars": (0, 3, 4, 7, 30, 10**6),
    "tilt_window": (NAN, -1.0, 0.02, 0.2, 60.0),
    "altitude": (NAN, 8848.0, INF),
    "clock_stddev": (NAN, 0.01, 2.0, 3600.0, -1.0, INF),
    "tilt_stddev": (NAN, 0.0035, 1.0, 0.0, 100.0),
    "deflection.stddev": (0.0, 6.0, 120.0, 121.0, NAN),
    "refraction.pressure": (NAN, -1.0, INF),
    "refraction.temperature": (NAN, 1000.0),
    "calibration_frames": (0, 1, 1000, 1001),
    "calibration_url": ("/none.yaml", "/dev/null", "", "file:///etc/passwd"),
    "self_calibration": (True, False),
    "frame_id": ("", "x" * 1000, "base_link"),
    "misalignment_stddev": (5.0, 3600.0, -1.0, NAN),
    "use_sim_time": (7, "x"),
    "tilt_timeout": (0.0, 0.02, 0.2, -1.0, INF),
    "no_such_parameter": (1, "x", [1.0]),
}


@kind(2)
def parameters_set(w: World):
    """One to three of the solver's parameters to anything, allowed or not; after a frame they are set back."""
    names = w.rng.choice(sorted(WILD), w.rng.integers(1, 4), replace=False)
    values = {str(n).replace(".", "__"): WILD[n][w.rng.integers(len(WILD[n]))] for n in names}
    w.graph.set("solver", **values)
    w.good()
    w.restore_parameters()
