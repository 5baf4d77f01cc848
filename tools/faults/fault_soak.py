# SPDX-License-Identifier: Apache-2.0
"""Thousands of random faults from all inputs into the installed nodes, and the outcome of each kind.

A simulated instrument in accelerated time (/clock) sends star lists to the solver and small images to the detector;
between the faults it turns and drives.  Nodes wait more than they compute, so several such instruments run at a time,
each in a ROS domain of its own.  Every fix of every topic is held against where it truly was: one further off
than 5 of its own sigmas is wrong.  Prints a table in Markdown.  Exit status 0 only with no wrong fix, no crash, no
defect in a log, recovery after every fault, and memory that stays.
"""

import math
import multiprocessing
import signal
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from runner import Memory, Progress, seed_of_the_day

from starpos_testing.domain import own_domain

ROOT = Path(__file__).resolve().parents[2]

# Share of the faults before memory is compared.
WARM = 0.1
FAULTS_A_RESTART = 400
# Chance of a turn or a drive before a fault.
LEGITIMATE = 0.04
# Most good frames after a fault, of at most a second each.
PATIENCE = 30
# With fewer faults memory is not compared, because the first of each kind takes memory for good.
MIN_FOR_MEMORY = 2000
# Largest growth of a node: its allocator's memory varies by 10 MB however long it runs.
GROWN_MB = 12.0


@dataclass(kw_only=True)
class Row:
    """Outcomes of one kind of fault."""

    about: str
    injected: int = 0
    statuses: Counter = field(default_factory=Counter)
    right: int = 0
    wrong: int = 0
    # Good frames until a fix, including the one with the fix.
    frames: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


@dataclass(kw_only=True)
class Outcome:
    """What came of the faults of one instrument, or of several; see `Row` and `accelerated.World`."""

    rows: dict[str, Row] = field(default_factory=dict)
    right: Counter = field(default_factory=Counter)
    sigmas: dict[str, list[float]] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    crashes: list[str] = field(default_factory=list)
    stuck: list[str] = field(default_factory=list)
    # Most memory (MB) of a node, early and late.
    memory: list[tuple[str, float, float]] = field(default_factory=list)

    @property
    def injected(self) -> int:
        return sum(row.injected for row in self.rows.values())

    @property
    def good(self) -> bool:
        """Whether nothing went wrong, and no node has grown."""
        told = self.injected >= MIN_FOR_MEMORY
        flat = not told or all(last - first < GROWN_MB for _, first, last in self.memory)
        return flat and not (self.wrong or self.crashes or self.stuck)

    def add(self, other: "Outcome"):
        """Take in the faults of another instrument."""
        for name, row in other.rows.items():
            mine = self.rows.setdefault(name, Row(about=row.about))
            for counted in ("injected", "statuses", "right", "wrong", "frames", "seconds"):
                setattr(mine, counted, getattr(mine, counted) + getattr(row, counted))
        for topic, of in other.sigmas.items():
            self.sigmas.setdefault(topic, []).extend(of)
        self.right += other.right
        for kept in ("wrong", "crashes", "stuck", "memory"):
            getattr(self, kept).extend(getattr(other, kept))


class Soak:
    """The nodes, the instrument around them, and the counts of outcomes."""

    def __init__(self, folder: Path, seed: int):
        from accelerated import World, parameters_of
        from kinds import KINDS

        from starpos_testing.graph.graph import Graph

        self.folder, self.graph = folder, Graph()
        self.parameters = parameters_of(folder)
        self.world = World(self.graph, seed, self.parameters)
        self.kinds = KINDS
        self.rows = {k.name: Row(about=k.about) for k in KINDS}
        self.crashes: list[str] = []
        self.stuck: list[str] = []
        self.nodes, self.starts = {}, 0
        for name in ("solver", "detector"):
            self.start(name)

    def start(self, name: str):
        self.starts += 1
        package = {"solver": "starpos_solver", "detector": "starpos_camera"}[name]
        values = self.parameters if name == "solver" else {"use_sim_time": True}
        texts = [f"{k}:={_yaml(v)}" for k, v in values.items()]
        self.nodes[name] = self.graph.start(self.folder / f"{self.starts}-{name}.log", package, name, *texts)

    def end(self, name: str, kill: bool):
        """End a node as a supervisor does; look at its exit status and log."""
        node = self.nodes[name]
        node.signal(signal.SIGKILL if kill else signal.SIGTERM)
        status = node.wait()
        if not kill and status != 0:
            self.crashes.append(f"{name} ended with {status} at SIGTERM")
        self.graph.processes.remove(node)
        self._look_at(node)

    def _look_at(self, node):
        if "Traceback" in node.output:
            where = max(node.output.index("Traceback") - 500, 0)
            self.crashes.append(f"a defect in the log of {node.name}: {node.output[where:][:3000]}")

    def watch(self):
        """Check that all nodes live; a dead one counts as a crash and is started again."""
        for name, node in self.nodes.items():
            if (status := node.process.poll()) is not None:
                self.crashes.append(f"{name} has ended by itself with {status}: {node.output[-1500:]}")
                self.graph.processes.remove(node)
                self.start(name)

    def settle(self, image: bool = False) -> tuple[int, float]:
        """Send good frames until one gives a fix; return their number, 0 if none does, and the seconds."""
        begin = time.monotonic()
        sent: list[tuple[int, int]] = []
        for n in range(1, PATIENCE + 1):
            if self.world.good_image(sent) if image else self.world.good(sent):
                return n, time.monotonic() - begin
            self.watch()
        return 0, time.monotonic() - begin

    def legitimate(self):
        """Make a turn or a drive, and some frames there, which is no fault."""
        world = self.world
        if world.rng.random() < 0.5:
            world.turn()
        else:
            world.drive()
        for _ in range(4):
            self.settle()
        self._judge("turning and driving")

    def _judge(self, name: str) -> Row:
        row = self.rows.setdefault(name, Row(about="no fault"))
        right, wrong = self.world.right.total(), len(self.world.wrong)
        row.statuses += self.world.judge()
        row.right += self.world.right.total() - right
        row.wrong += len(self.world.wrong) - wrong
        for line in self.world.wrong[wrong:]:
            print(f"WRONG after {name}: {line}", file=sys.stderr, flush=True)
        return row

    def inject(self, name: str, about: str, fault, image: bool = False):
        """Inject one fault, and send good frames after it."""
        row = self.rows.setdefault(name, Row(about=about))
        row.injected += 1
        fault()
        frames, seconds = self.settle(image)
        self.watch()
        if not frames:
            self.stuck.append(f"no fix within {seconds:.0f} s after {name}")
            print(self.stuck[-1], file=sys.stderr, flush=True)
        row.frames.append(frames or PATIENCE)
        row.seconds.append(seconds)
        self._judge(name)

    def any_fault(self):
        rng = self.world.rng
        if rng.random() < LEGITIMATE:
            self.legitimate()
        weights = [k.weight for k in self.kinds]
        kind = rng.choice(self.kinds, p=[w / sum(weights) for w in weights])
        image = kind.name.startswith(("images", "captures"))
        self.inject(kind.name, kind.about, lambda: kind.inject(self.world), image)

    def restart(self):
        name = str(self.world.rng.choice(list(self.nodes)))
        kill = self.world.rng.random() < 0.5

        def fault():
            self.end(name, kill)
            self.start(name)

        how = "kill -9" if kill else "SIGTERM"
        about = f"{how}, and started again; the time until a fix holds its start"
        self.inject(f"{name} {'killed' if kill else 'ended'}", about, fault, name == "detector")

    def close(self):
        """End the nodes; count defects from their logs, and crashes from their exit."""
        for name in self.nodes:
            self.end(name, kill=False)
        self.graph.close()


def _yaml(value) -> str:
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else str(value)


def soaked(faults: int, seed: int) -> Outcome:
    """Inject a number of faults into one instrument, in a ROS domain of its own."""
    restarts = max(4, faults // FAULTS_A_RESTART)
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        soak, memory = Soak(Path(folder), seed), {}
        progress = Progress(faults, f"faults of seed {seed}")
        world = soak.world
        try:
            assert soak.settle()[0] and soak.settle(image=True)[0], "no fix before any fault"
            world.judge()
            for k in range(faults - restarts):
                soak.any_fault()
                if k >= WARM * faults:
                    for name, node in soak.nodes.items():
                        memory.setdefault(name, Memory(node.process.pid)).look()
                progress.at(k, len(world.wrong), "wrong")
            for _ in range(restarts):
                soak.restart()
        finally:
            soak.close()
    return Outcome(
        rows=soak.rows,
        right=world.right,
        sigmas=world.sigmas,
        wrong=world.wrong,
        crashes=soak.crashes,
        stuck=soak.stuck,
        memory=[(f"{name} {seed}", *seen.halves) for name, seen in memory.items()],
    )


def run_lanes(faults: int, seed: int, lanes: int) -> list[Outcome]:
    """Share the faults among a number of instruments at a time."""
    if lanes == 1:
        return [soaked(faults, seed)]
    shares = [len(range(k, faults, lanes)) for k in range(lanes)]
    with ProcessPoolExecutor(lanes, multiprocessing.get_context("spawn")) as pool:
        return list(pool.map(soaked, shares, range(seed, seed + lanes)))


def _spread(sigmas: dict[str, list[float]]) -> str:
    """Rms and largest error by topic, in sigmas (for a place, which has two coordinates, an rms of 1.41 is right)."""
    return "; ".join(
        f"{topic} {math.sqrt(sum(s * s for s in of) / len(of)):.2f}, {max(of):.1f}"
        for topic, of in sigmas.items()
    )


def table(rows: dict[str, Row]) -> str:
    """Write the table in Markdown."""
    lines = ["| fault | what | injected | answered | right | wrong | frames to a fix | s to a fix |"]
    lines.append("| --- | --- | ---: | --- | ---: | ---: | --- | --- |")
    for name, row in rows.items():
        if not row.injected and not row.statuses:
            continue
        answered = ", ".join(f"{n} {status}" for status, n in row.statuses.most_common())
        frames = f"{median(row.frames):g}, at most {max(row.frames)}" if row.frames else ""
        seconds = f"{median(row.seconds):.2f}, at most {max(row.seconds):.2f}" if row.frames else ""
        cells = (name, row.about, row.injected or "", answered, row.right, row.wrong, frames, seconds)
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def options(parser) -> None:
    parser.add_argument("--faults", type=int, default=10000)
    parser.add_argument("--seed", type=int, default=seed_of_the_day(), help="default: of the day")
    parser.add_argument("--lanes", type=int, default=3, help="instruments at a time")


def run(options) -> int:
    begin, outcome = time.monotonic(), Outcome()
    each = run_lanes(options.faults, options.seed, options.lanes)
    for one in each:
        outcome.add(one)
    report(
        outcome,
        f"--faults {options.faults} --lanes {options.lanes} --seed {options.seed}",
        time.monotonic() - begin,
    )
    return int(not all(one.good for one in each))


def report(outcome: Outcome, options: str, seconds: float):
    """Print what happened."""
    from kinds import UNTOLD

    print(f"`tools/soaks/soak.py faults {options}`:\n")
    print(table(outcome.rows))
    right = ", ".join(f"{n} of {topic}" for topic, n in outcome.right.items())
    print(f"\n{outcome.injected} faults in {seconds / 60:.0f} min; right: {right}; wrong: {len(outcome.wrong)}; "
          f"crashes and defects: {len(outcome.crashes)}; without recovery: {len(outcome.stuck)}")  # fmt: skip
    print(f"off by, in their own sigmas, rms and most: {_spread(outcome.sigmas)}")
    grown = [f"{name} {first:.0f} then {last:.0f} MB" for name, first, last in outcome.memory]
    print(f"most memory in the first and in the last half: {'; '.join(grown)}")
    print(f"\n{UNTOLD}")
    for line in (*outcome.wrong, *outcome.crashes, *outcome.stuck):
        print(line, file=sys.stderr)
