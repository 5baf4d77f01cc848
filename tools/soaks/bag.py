# SPDX-License-Identifier: Apache-2.0
"""A bag again and again through fresh nodes, next to busy processes: are all outputs the same to the last byte?

Plays the first 10 s of the tests' night (--inputs images: 10 s of its images, by the detector), records the results by a
listener that listens to the inputs too, and compares `fix`, `attitude`, `solver/solution` and `fix_averaged`.  In 4
processes: solver, detector, player, listener; in 1: all but the listener.  Exit status 0 only if all runs agree and
every frame was answered.
"""

import argparse
import hashlib
import itertools
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from starpos_testing.domain import own_domain
from starpos_testing.patience import WAIT_S
from starpos_testing.skies.bags import knowing, part_of

NIGHT = Path(__file__).resolve().parents[2] / "test" / "data" / "night"
SECONDS = 10
# where in the night they begin, by the player's --inputs
BEGIN_S = {"stars": 0, "images": 57}
OUTPUTS = {
    "fix": "sensor_msgs/msg/NavSatFix",
    "solver/solution": "starpos_interfaces/msg/Solution",
    "fix_averaged": "sensor_msgs/msg/NavSatFix",
    "attitude": "starpos_interfaces/msg/Attitude",
}


@dataclass(frozen=True)
class Outcome:
    """The result of a run: how many messages of each output, a digest of their bytes, why it failed."""

    messages: tuple[int, ...] = ()
    digest: str = ""
    trouble: str = ""


def parameters() -> list[str]:
    """The parameters of a solver that knows the night's instrument."""
    return knowing(json.loads(NIGHT.with_suffix(".json").read_text()))


class Listener:
    """Keeps what is published, as bytes without rmw's padding, and listens to the inputs as others may."""

    def __init__(self, graph):
        from functools import partial
        from importlib import import_module

        from starpos.recording.bag import installed_types

        self.store, self.kept = installed_types(), {name: [] for name in OUTPUTS}
        inputs = {"stars": "starpos_interfaces/msg/StarArray", "tilt": "starpos_interfaces/msg/Tilt"}
        for name, kind in (OUTPUTS | inputs).items():
            package, message = kind.split("/msg/")
            of_ros = getattr(import_module(f"{package}.msg"), message)
            graph.node.create_subscription(of_ros, name, partial(self._keep, name, kind), 1000, raw=True)

    def _keep(self, name, kind, data):
        if name in OUTPUTS:
            message = self.store.deserialize_cdr(data, kind)
            self.kept[name].append(bytes(self.store.serialize_cdr(message, kind)))

    def outcome(self) -> Outcome:
        digest = hashlib.sha256(b"".join(itertools.chain(*self.kept.values()))).hexdigest()
        return Outcome(tuple(map(len, self.kept.values())), digest)


def play(bag: Path, inputs: str, rate: float, processes: int) -> Outcome:
    """Play a bag once through fresh nodes in a domain of their own."""
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        from starpos_testing.graph.graph import Graph

        graph = Graph()
        try:
            return _play(graph, Path(folder), bag, inputs, rate, processes)
        finally:
            graph.close()


def _play(graph, folder: Path, bag: Path, inputs: str, rate: float, processes: int) -> Outcome:
    listener = Listener(graph)
    # this end must not seem to be an instrument
    for publisher in (graph.info, graph.stars, graph.tilt, graph.capture):
        graph.node.destroy_publisher(publisher)
    arguments = (str(bag), "--rate", f"{rate:g}", "--inputs", inputs)
    if processes == 1:
        command = [
            sys.executable,
            str(Path(__file__).with_name("replay_in_one.py")),
            *arguments,
            "--ros-args",
        ]
        command += [word for p in parameters() for word in ("-p", p)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=2 * WAIT_S, check=False)
        status, output = done.returncode, done.stdout + done.stderr
    else:
        graph.start(folder / "solver", "starpos_solver", "solver", *parameters())
        graph.start(folder / "detector", "starpos_camera", "detector", "use_sim_time:=true")
        player = graph.start(folder / "replay", "starpos_bringup", "replay", arguments=arguments)
        graph.comes(lambda: player.process.poll() is not None, 2 * WAIT_S)
        status, output = player.wait(), player.output
    if status:
        return Outcome(trouble=f"the player ended with {status}: {output}")
    answers = int(output.rsplit(" answers", 1)[0].rsplit(" ", 1)[1])
    if not graph.comes(lambda: len(listener.kept["solver/solution"]) >= answers, WAIT_S):
        return Outcome(trouble=f"{answers} answers, {len(listener.kept['solver/solution'])} of them heard")
    # the others may come after the solution of their frame
    graph.comes(lambda: False, 0.5)
    return listener.outcome()


def busy():
    """Compute until the process is ended."""
    while True:
        pass


def options(parser) -> None:
    parser.add_argument("--runs", type=int, default=50, help="of each kind (50)")
    parser.add_argument("--busy", type=int, default=8, help="processes that compute beside (8)")
    parser.add_argument("--rates", type=float, nargs="+", default=[0.0, 1.0, 10.0])
    parser.add_argument("--processes", type=int, nargs="+", choices=(1, 4), default=[1, 4])
    parser.add_argument("--inputs", choices=tuple(BEGIN_S), default="stars")
    parser.add_argument("--lanes", type=int, default=2, help="runs at a time (2)")


def run(options) -> int:
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=busy, daemon=True) for _ in range(options.busy)]
    for other in others:
        other.start()
    try:
        with tempfile.TemporaryDirectory() as folder:
            bag = part_of(NIGHT, Path(folder) / "bag", BEGIN_S[options.inputs], SECONDS)
            return compare(bag, options, context)
    finally:
        for other in others:
            other.kill()


def compare(bag: Path, options: argparse.Namespace, context) -> int:
    """Run all kinds; returns the exit status."""
    seen: Counter[Outcome] = Counter()
    with ProcessPoolExecutor(options.lanes, mp_context=context, max_tasks_per_child=1) as lanes:
        for processes, rate in itertools.product(options.processes, options.rates):
            begin = time.monotonic()
            futures = [lanes.submit(play, bag, options.inputs, rate, processes) for _ in range(options.runs)]
            outcomes = Counter(future.result() for future in futures)
            seen += outcomes
            said = "; ".join(
                f"{n} times {o.trouble or f'{o.messages} {o.digest[:8]}'}" for o, n in outcomes.items()
            )
            print(
                f"rate {rate:g}, processes {processes}, {time.monotonic() - begin:.0f} s: {said}", flush=True
            )
    same = len(seen) == 1 and all(o.messages and min(o.messages) for o in seen)
    print(f"{seen.total()} runs, {len(seen)} different outcomes")
    return int(not same)
